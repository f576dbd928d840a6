"""The Explore sections at the end of the notebooks: sliders, and the pictures that they change.

In JupyterLab `show` puts the controls above a picture and draws it anew when one of them is moved.
Where the report is built it draws the picture once, at the values that the controls start with.
"""

from dataclasses import replace

import gtsam
import numpy as np
from IPython.display import display
from ipywidgets import Box, Dropdown, FloatSlider, IntSlider, Layout, VBox, interactive_output

from slamlib import evaluation, fusion, initial, localization, odometry, plotting, se2, slam
from slamlib.notebook import Log, interactive
from slamlib.simulation import misguess, simulate

LEAST_PATH = 1.0             # m, what drives less shows nothing
SLIP = 1e-3                  # sqrt(m), of simulated drives where no slider sets it
LEAST_ERROR = 1.0            # mm, where the axis of errors begins
KERNELS = {f"{scale} σ": scale for scale in (1, 3, 10, 30, 100)} | {"none": None}
ROW = Layout(display="flex", flex_flow="row wrap")


def slider(label, start, low, high, step=1):
    """A slider: of whole numbers if all its numbers are, else of real ones."""
    whole = all(isinstance(number, int) for number in (start, low, high, step))
    return (IntSlider if whole else FloatSlider)(start, min=low, max=high, step=step,
                                                 description=label)


def choice(label, options, start):
    """A list of names to choose from, which starts with the name `start`; its value is the name."""
    return Dropdown(options=list(options), value=start, description=label)


def show(draw, **controls):
    """Show the figure that draw(**values) makes, and controls for the values in JupyterLab.

    Parameters
    ----------
    draw : function that makes one figure from the controls' values, given by name.
    controls : widgets with a value, such as `slider` and `choice` make.
    """
    if not interactive():
        draw(**{name: control.value for name, control in controls.items()})
        return
    for control in controls.values():
        control.continuous_update = False              # draw when it is let go, and not on the way
        control.style.description_width = "12em"
        control.layout.width = "31em"
    display(VBox([Box(list(controls.values()), layout=ROW), interactive_output(draw, controls)]))


def drive(logs):
    """The shortest of the logs that goes anywhere, or else a simulated one."""
    def length(log):
        return evaluation.path_length(odometry.dead_reckoning(log.dataset.ticks, log.dataset.vehicle))
    some = (log for log in logs if length(log) >= LEAST_PATH)
    return next(some, None) or Log("simulated", *simulate("short", seed=1), made_up=True)


def wheels(log, right, left, base, sigma_radii, sigma_base, probability, count):
    """Chapter 1: the path with other wheels on the same counts, among the ellipses of equation 2.

    Parameters
    ----------
    log : Log
    right, left, base : errors of R_R, R_L and b in units of their nominal standard deviations.
    sigma_radii, sigma_base : factors on the standard deviations that equation 2 is told.
    probability, count : of the ellipses, in percent, and their number.
    """
    ticks, v = log.dataset.ticks, log.dataset.vehicle
    other = odometry.dead_reckoning(ticks, v.with_wheel(v.wheel + v.sigma_wheel * (right, left, base)))
    poses, covariances = odometry.equation2(ticks, replace(
        v, sigma_right_radius=v.sigma_right_radius * sigma_radii,
        sigma_left_radius=v.sigma_left_radius * sigma_radii,
        sigma_wheelbase=v.sigma_wheelbase * sigma_base))
    at, color = plotting.spread(poses, count), plotting.ROLES["odometry"]["color"]
    name = f"{probability} % by equation 2"
    fig, axes = plotting.panels(2, height=3.6)
    (plan,), (side,) = axes
    plotting.trajectory(plan, poses, "odometry", "nominal wheels")
    plotting.ellipses(plan, poses[at], covariances[at], color, probability / 100, name)
    plotting.trajectory(plan, other, "alternative", "wheels of the sliders")
    plan.set_title(log.name)
    k = np.sqrt(-2 * np.log(1 - probability / 100))
    longest = k * np.sqrt(np.linalg.eigvalsh(covariances[:, :2, :2])[:, 1])
    side.fill_between(np.arange(len(poses)) + 1, longest, color=color, alpha=0.18, linewidth=0,
                       label="its longer half-axis")
    plotting.curve(side, np.hypot(*(other - poses)[:, :2].T), "alternative",
                   label="wheels of the sliders")
    if log.truth is not None:
        plotting.trajectory(plan, log.truth.poses, "truth")
        plotting.curve(side, np.hypot(*(log.truth.poses - poses)[:, :2].T), "truth")
        plan.set_title(f"{log.name}: {evaluation.ate(other, log.truth.poses):.3f} m off the truth")
    side.set(ylabel="distance from nominal (m)", ylim=(0, None))
    plotting.legend_below(fig)
    return fig


def cameras(seed, every, reach, claimed):
    """Chapter 2: markers alone, and fused with odometry, by a slower or more short-sighted camera.

    Parameters
    ----------
    seed : of a simulated drive of the short path.
    every : only every so many-th frame of the camera is used.
    reach : m, only markers nearer than that are seen.
    claimed : factor on the standard deviations that come with the sightings; their errors stay.
    """
    dataset, truth = simulate("short", seed, slip=SLIP)
    a = dataset.aruco
    frames = np.unique(a.pose)[::every]
    kept = np.isin(a.pose, frames) & (np.hypot(*a.marker_in_vehicle[:, :2].T) <= reach)
    aruco = replace(a, pose=a.pose[kept], marker=a.marker[kept],
                    marker_in_vehicle=a.marker_in_vehicle[kept],
                    covariance=a.covariance[kept] * claimed**2)
    fig, axes = plotting.panels(2, height=3.6)
    (plan,), (side,) = axes
    path = odometry.dead_reckoning(dataset.ticks, dataset.vehicle)
    plotting.trajectory(plan, truth.poses, "truth")
    plotting.trajectory(plan, path, "odometry")
    _error(side, path, truth.poses, "odometry")
    if len(frames := np.unique(aruco.pose)):
        fused = fusion.fuse(replace(dataset, aruco=aruco), slip=SLIP)
        alone = localization.localize(aruco)
        known = np.isfinite(alone.poses[:, 0])
        poses = se2.compose(truth.poses[frames[known][0]], alone.poses)
        plotting.trajectory(plan, poses, "aruco", "markers alone")
        plotting.trajectory(plan, fused.poses, "fused")
        k = plotting.enlargement(fused.poses, fused.covariances)
        at = plotting.spread(fused.poses, 10)
        plotting.ellipses(plan, fused.poses[at], fused.covariances[at],
                          plotting.ROLES["fused"]["color"], enlarged=k)
        _error(side, poses, truth.poses[frames], "aruco", "markers alone", at=frames)
        _error(side, fused.poses, truth.poses, "fused")
        nees = evaluation.anees(fused.poses[frames], fused.covariances[frames], truth.poses[frames])
        plan.set_title(f"{len(aruco.pose)} sightings (ellipses × {k})")
        if np.isfinite(nees):
            side.set_title(f"fused: {fused.outliers} left out, NEES {nees:.1f}")
    side.set_ylim(LEAST_ERROR, 2 * side.dataLim.y1)
    plotting.legend_below(fig)
    return fig


def graphs(seed, slip, assumed, wrong, kernel, start):
    """Chapter 3: the graph solved with a single kernel, beside the solver that narrows it in rounds.

    Parameters
    ----------
    seed : of a simulated drive of the short path.
    slip, assumed : mm after one metre, of the drive and of the graph.
    wrong : percent of the sightings that carry another marker's label.
    kernel : one of KERNELS, the Cauchy kernel's scale in sigmas.
    start : one of initial.LANDMARKS, where the markers start in the single kernel's graph.
    """
    dataset, truth = simulate("short", seed, slip=1e-3 * slip, mislabelled=wrong / 100)
    graph = slam.Graph(replace(dataset, uwb=None), "arc")
    assumed = max(1e-3 * assumed, fusion.SLIPS[0])
    U, _ = graph.factors.whitening(assumed)
    scale = KERNELS[kernel]
    native = graph.native(gtsam.noiseModel.mEstimator.Cauchy.Create(scale) if scale else None)
    values, _, _ = graph.optimize(initial.from_odometry(graph, start), native, U)
    poses, markers = graph.state(values).poses, graph.state(values).markers
    solved = slam.result(slam.solve_graph(graph, assumed))
    fig, axes = plotting.panels(2, height=3.6)
    (plan,), (side,) = axes
    plotting.trajectory(plan, truth.poses, "truth")
    plotting.trajectory(plan, poses, "alternative", "single kernel")
    plotting.trajectory(plan, solved.poses, "slam", "rounds of kernels")
    for marker, in_world, role in ((graph.marker, markers, "alternative"),
                                   (solved.marker, solved.marker_in_world, "slam")):
        true = truth.marker_in_world[np.searchsorted(truth.marker, marker)]
        ends = np.stack([true[:, :2], in_world[:, :2]])
        plan.plot(*ends.T.swapaxes(1, 2), color=plotting.ROLES[role]["color"], linewidth=1.2)
    plan.plot(*truth.marker_in_world[:, :2].T, label="true markers", **plotting.ROLES["marker"])
    low, high = truth.marker_in_world[:, :2].min(0) - 0.5, truth.marker_in_world[:, :2].max(0) + 0.5
    plan.set_aspect("equal", adjustable="box")               # and what is far off is cut off
    plan.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    plan.set_title(f"{len(solved.outlier)} sightings")
    _error(side, poses, truth.poses[graph.frame], "alternative", "single kernel", at=graph.frame)
    _error(side, solved.poses, truth.poses, "slam", "rounds of kernels")
    nees = evaluation.anees(solved.poses, solved.covariances, truth.poses)
    side.set_title(f"rounds: {np.count_nonzero(solved.outlier)} left out, NEES {nees:.1f}")
    side.set_ylim(LEAST_ERROR, 2 * side.dataLim.y1)
    plotting.legend_below(fig)
    return fig


def ranges(seed, late, off, poses, way):
    """Chapter 4: ranges and wheels alone, by one kernel from the guess, and by the solver.

    Parameters
    ----------
    seed : of a simulated drive of the short path.
    late : percent of the ranges that are too long.
    off : m, error of the antenna guess, in a direction of its own for each antenna.
    poses : of the drive, the first ones.
    way : one of slam.RANGES.
    """
    dataset, truth = simulate("short", seed, slip=SLIP, late_ranges=late / 100)
    dataset = initial.prefix(misguess(dataset.without("aruco"), truth, off, seed), poses)
    guess = dataset.antenna_guess.position
    true_poses = truth.poses[:poses]
    chosen, solved = (slam.result(slam.solve_graph(slam.Graph(dataset, "arc"), SLIP, **options))
                      for options in (dict(ranges=way, antennas="guess"), {}))
    fig, axes = plotting.panels(2, height=3.6)
    (plan,), (side,) = axes
    plotting.trajectory(plan, true_poses, "truth")
    for found, role, label in ((chosen, "alternative", "kernel of the sliders"),
                               (solved, "slam", "solver")):
        plotting.trajectory(plan, found.poses, role, label)
        ends = np.stack([guess[np.searchsorted(truth.antenna, found.antenna)], found.antenna_in_world])
        plan.plot(ends[..., 0], ends[..., 1], color=plotting.ROLES[role]["color"], linewidth=1.2)
        _error(side, found.poses, true_poses, role, label)
    plan.plot(*guess.T, label="antennas: guess", **plotting.ROLES["guess"])
    plan.plot(*truth.antenna_in_world.T, label="antennas: truth", **plotting.ROLES["true antenna"])
    miss = np.hypot(*(solved.antenna_in_world - truth.antenna_in_world[
        np.searchsorted(truth.antenna, solved.antenna)]).T)
    plan.set_title(f"antennas within {miss.max():.2f} m")
    nees = evaluation.anees(solved.poses, solved.covariances, true_poses)
    side.set_title(f"NEES {nees:.1f}, {len(solved.doubts)} in doubt")
    side.set_ylim(LEAST_ERROR, 2 * side.dataLim.y1)
    plotting.legend_below(fig)
    return fig


def _error(ax, poses, truth, role, label=None, **look):
    """Distance (mm) from the truth over the pose number, on a logarithmic axis."""
    apart = np.hypot(*(poses - truth)[:, :2].T)
    plotting.curve(ax, 1e3 * apart, role, label=label, **look)
    ax.set(yscale="log", ylabel="error of position (mm)")
    ax.yaxis.set_major_formatter("{x:g}")
