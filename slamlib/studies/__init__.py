"""Studies that justify choices: Monte Carlo trials, kernels, graphs, starts, a real log.

    memory       runs a trial over many seeds, and keeps its numbers between builds
    workers      the processes in which trials run
    montecarlo   trials: each problem's methods against the truth of a simulated drive
    kernels      kernels and gates against wrong labels and late ranges, among them GNC
    correlation  errors with memory, and a solver that knows their correlation
    graphs       kinds of graphs, and the evidence over the slip
    starts       where markers and antennas start
    plaza        the log Plaza 2 in the assignment's format
"""

from slamlib.studies.memory import run

__all__ = ["run"]
