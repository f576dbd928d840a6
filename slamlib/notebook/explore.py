"""The Explore sections at the end of the notebooks: one figure each, with controls in JupyterLab.

In JupyterLab `show` displays the controls above the figure and redraws it when a value changes. In
the report it draws the figure with the initial values of the controls; in its HTML page some of
them can be moved, among a few values for which the figure is drawn when the report is built.
"""

from dataclasses import replace
from functools import lru_cache

import gtsam
import numpy as np
from IPython.display import display
from ipywidgets import Box, Dropdown, FloatSlider, IntSlider, Layout, VBox, interactive_output

from slamlib import evaluation, localization, odometry, se2
from slamlib.increments import TYPICAL_SLIP
from slamlib.notebook import plotting
from slamlib.notebook.live import live
from slamlib.notebook.show import Drive, interactive
from slamlib.simulation import misguess, simulate
from slamlib.slam.estimate import fit_from_odometry
from slamlib.slam.initialization import odometry_state, trilaterated_antennas
from slamlib.slam.measurement_factors import MeasurementFactors
from slamlib.slam.measurements import measure
from slamlib.slam.noise import Noise, given, with_known
from slamlib.slam.optimizer import optimize
from slamlib.slam.problem import build
from slamlib.slam.result import result
from slamlib.studies.kernels import solve_with
from slamlib.studies.starts import LANDMARKS, guessed_antennas

MINIMUM_PATH = 1.0           # m, path length from which a drive is worth drawing
SMALLEST_ERROR = 1.0         # mm, lower limit of the axis of errors
WRONG_PLACE = 0.5            # m, error of a marker that is mapped at a wrong place
KERNELS = {f"{scale} σ": scale for scale in (1, 3, 10, 30, 100)} | {"none": None}   # Cauchy scales
ROW = Layout(display="flex", flex_flow="row wrap")


def slider(label, start, low, high, step=1):
    """A slider from `low` to `high`, of integers if all its numbers are, else of floats."""
    whole = all(isinstance(number, int) for number in (start, low, high, step))
    return (IntSlider if whole else FloatSlider)(start, min=low, max=high, step=step,
                                                 description=label)


def choice(label, options, start):
    """A drop-down list of names; its value is the name chosen, `start` at first."""
    return Dropdown(options=list(options), value=start, description=label)


def show(draw, grid=None, **controls):
    """Show the figure of draw(**values), in JupyterLab with controls of the values.

    Parameters
    ----------
    draw : function of the controls' values, by name, that makes one figure.
    grid : dict by name of the values (list) that some controls have in the report's HTML page.
    controls : widgets with a value, as of `slider` and `choice`.
    """
    if not interactive():
        live(draw, controls, grid or {})
        return
    for control in controls.values():
        control.continuous_update = False              # redraw on release only
        control.style.description_width = "12em"
        control.layout.width = "31em"
    display(VBox([Box(list(controls.values()), layout=ROW), interactive_output(draw, controls)]))


def moving_drive(drives):
    """The first Drive with a path of at least MINIMUM_PATH, or else a simulated one."""
    for drive in drives:
        d = drive.dataset
        if evaluation.path_length(odometry.dead_reckoning(d.ticks, d.vehicle)) >= MINIMUM_PATH:
            return drive
    return Drive("simulated", *simulate("short", seed=1), made_up=True)


def wheels(drive, right, left, base, sigma_radii, sigma_base, probability, count):
    """Chapter 1: odometry with other wheel parameters, and the ellipses of equation 2. The figure.

    Parameters
    ----------
    drive : Drive
    right, left, base : errors of R_R, R_L and b in units of their nominal standard deviations.
    sigma_radii, sigma_base : factors on the standard deviations of equation 2.
    probability : percent, of the ellipses.
    count : number of ellipses.
    """
    ticks, v = drive.dataset.ticks, drive.dataset.vehicle
    other = odometry.dead_reckoning(ticks, v.with_deviation(np.array([right, left, base])))
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
    plan.set_title(plotting.literal(drive.name))
    k = np.sqrt(-2 * np.log(1 - probability / 100))
    longest = k * np.sqrt(np.linalg.eigvalsh(covariances[:, :2, :2])[:, 1])
    side.fill_between(np.arange(len(poses)) + 1, longest, color=color, alpha=0.18, linewidth=0,
                       label="semi-major axis")
    plotting.curve(side, np.hypot(*(other - poses)[:, :2].T), "alternative",
                   label="wheels of the sliders")
    if drive.truth is not None:
        plotting.trajectory(plan, drive.truth.poses, "truth")
        plotting.curve(side, np.hypot(*(drive.truth.poses - poses)[:, :2].T), "truth")
        plan.set_title(f"{plotting.literal(drive.name)}: "
                       f"ATE {evaluation.ate(other, drive.truth.poses):.3f} m")
    side.set(ylabel="distance from nominal (m)", ylim=(0, None))
    plotting.legend_below(fig)
    fig.said = _said_of_wheels(v, np.array([right, left, base]), poses[-1], other[-1])
    return fig


def _said_of_wheels(vehicle, deviation, end, other):
    """What wrong wheels, off by deviation (3,) in sigmas, do to the last pose (3,) of the path."""
    off = 100 * deviation * vehicle.sigma_wheel / vehicle.wheel                        # percent
    names = (("right wheel", "large", "small"), ("left wheel", "large", "small"),
             ("wheelbase", "long", "short"))
    wrong = [f"{name} {abs(each):.2g} % too {more if each > 0 else less}"
             for each, (name, more, less) in zip(off, names, strict=True) if each]
    if not wrong:
        return "Nominal wheels: both paths agree."
    turned = np.degrees(abs(other[2]) - abs(end[2]))
    told = (f"{' and '.join(wrong)}: the path turns {abs(turned):.1f}° "
            f"{'more' if turned > 0 else 'less'}, its end moves by "
            f"{np.hypot(*(other - end)[:2]):.2f} m.")
    return told[0].upper() + told[1:]


def cameras(seed, every, reach, claimed):
    """Chapter 2: localization from fewer sightings, by markers alone and fused. The figure.

    Parameters
    ----------
    seed : of a simulated drive of the short path.
    every : one frame of the camera in so many is used.
    reach : m, largest distance of a marker that is seen.
    claimed : factor on the reported standard deviations of the sightings, not on their errors.
    """
    dataset, truth = simulate("short", seed, slip=TYPICAL_SLIP)
    aruco = dataset.aruco
    used = np.isin(aruco.pose, np.unique(aruco.pose)[::every])
    aruco = aruco.select(used & (np.hypot(*aruco.marker_in_vehicle[:, :2].T) <= reach))
    aruco = replace(aruco, covariance=aruco.covariance * claimed**2)
    fig, axes = plotting.panels(2, height=3.6)
    (plan,), (side,) = axes
    path = odometry.dead_reckoning(dataset.ticks, dataset.vehicle)
    plotting.trajectory(plan, truth.poses, "truth")
    plotting.trajectory(plan, path, "odometry")
    _error(side, path, truth.poses, "odometry")
    frames = np.unique(aruco.pose)
    if len(frames):
        fused = localization.fuse(replace(dataset, aruco=aruco), slip=TYPICAL_SLIP)
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
        nees = evaluation.anees(fused.poses[frames], fused.covariances[frames],
                                truth.poses[frames])
        plan.set_title(f"{len(aruco.pose)} sightings (ellipses × {k})")
        if np.isfinite(nees):
            side.set_title(f"fused: {fused.rejected} rejected, NEES {nees:.1f}")
            low, high = evaluation.nees_band(1)
            fig.said = (f"Markers alone locate {np.count_nonzero(known)} of {len(frames)} frames. "
                        f"The NEES of the fusion is {nees:.1f}; on single drives consistent "
                        f"covariances give {low:.1f} to {high:.1f} in 95 % of the cases.")
    side.set_ylim(SMALLEST_ERROR, 2 * side.dataLim.y1)
    plotting.legend_below(fig)
    return fig


def graphs(seed, slip, assumed, wrong, kernel, start):
    """Chapter 3: the graph solved with one Cauchy kernel, and with kernels that narrow. The figure.

    Parameters
    ----------
    seed : of a simulated drive of the short path.
    slip, assumed : mm after 1 m, of the drive and of the graph.
    wrong : percent of the sightings with a wrong label.
    kernel : name in KERNELS.
    start : name in starts.LANDMARKS, for the single kernel.
    """
    m, truth, solved = _rounds(seed, slip, assumed, wrong)
    scale = KERNELS[kernel]
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(scale) if scale else None
    problem = replace(build(m, "arc", with_known(Noise(), m.dataset.vehicle)),
                      measured=MeasurementFactors(m, m.unit_weights, cauchy))
    single = optimize(problem, odometry_state(m, "arc", markers=LANDMARKS[start])).state
    fig, axes = plotting.panels(2, height=3.6)
    (plan,), (side,) = axes
    plotting.trajectory(plan, truth.poses, "truth")
    plotting.trajectory(plan, single.poses, "alternative", "single kernel")
    plotting.trajectory(plan, solved.poses, "slam", "rounds of kernels")
    wide = []
    for marker, in_world, role in ((m.marker, single.markers, "alternative"),
                                   (solved.marker, solved.marker_in_world, "slam")):
        true = truth.marker_in_world[np.searchsorted(truth.marker, marker)]
        ends = np.stack([true[:, :2], in_world[:, :2]])
        plan.plot(*ends.T.swapaxes(1, 2), color=plotting.ROLES[role]["color"], linewidth=1.2)
        wide.append(np.count_nonzero(np.hypot(*(ends[1] - ends[0]).T) > WRONG_PLACE))
    fig.said = (f"{wrong} % wrong labels: the single kernel maps {wide[0]} of {len(m.marker)} "
                f"markers more than {WRONG_PLACE} m from their true place, the rounds {wide[1]}.")
    plan.plot(*truth.marker_in_world[:, :2].T, label="true markers", **plotting.ROLES["marker"])
    low, high = truth.marker_in_world[:, :2].min(0) - 0.5, truth.marker_in_world[:, :2].max(0) + 0.5
    plan.set_aspect("equal", adjustable="box")          # markers far from the true map are cut off
    plan.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    plan.set_title(f"{len(solved.rejected)} sightings")
    _error(side, single.poses, truth.poses[m.frame], "alternative", "single kernel", at=m.frame)
    _error(side, solved.poses, truth.poses, "slam", "rounds of kernels")
    nees = evaluation.anees(solved.poses, solved.covariances, truth.poses)
    side.set_title(f"rounds: {np.count_nonzero(solved.rejected)} rejected, NEES {nees:.1f}")
    side.set_ylim(SMALLEST_ERROR, 2 * side.dataLim.y1)
    plotting.legend_below(fig)
    return fig


@lru_cache(maxsize=8)
def _rounds(seed, slip, assumed, wrong):
    """Measurements, Truth and SlamResult by rounds of kernels of the drive of `graphs`."""
    dataset, truth = simulate("short", seed, slip=1e-3 * slip, mislabelled=wrong / 100)
    m = measure(given(dataset.without("uwb"), 1e-3 * assumed, 1.0, 1.0))
    return m, truth, result(fit_from_odometry(m))


def ranges(seed, late, off, poses, way):
    """Chapter 4: ranges and odometry, by one kernel from the guess, and by the default. The figure.

    Parameters
    ----------
    seed : of a simulated drive of the short path.
    late : percent of the ranges that are too long.
    off : m, error of the antenna guesses, each in a random direction.
    poses : number of the drive's first poses that are used.
    way : name in kernels.RANGES.
    """
    dataset, truth = _late(seed, late, off, poses)
    guess = dataset.antenna_guess.position
    true_poses = truth.poses[:poses]
    chosen = _by_ranges(seed, late, off, poses, way, guessed_antennas)
    solved = _by_ranges(seed, late, off, poses, "asymmetric Tukey", trilaterated_antennas)
    fig, axes = plotting.panels(2, height=3.6)
    (plan,), (side,) = axes
    plotting.trajectory(plan, true_poses, "truth")
    for found, role, label in ((chosen, "alternative", "chosen kernel"),
                               (solved, "slam", "solver")):
        plotting.trajectory(plan, found.poses, role, label)
        first = guess[np.searchsorted(truth.antenna, found.antenna)]
        ends = np.stack([first, found.antenna_in_world])
        plan.plot(ends[..., 0], ends[..., 1], "o-", markevery=[1], markersize=4, linewidth=1.2,
                  color=plotting.ROLES[role]["color"])
        _error(side, found.poses, true_poses, role, label)
    plan.plot(*guess.T, label="antennas: guess", **plotting.ROLES["guess"])
    plan.plot(*truth.antenna_in_world.T, label="antennas: truth", **plotting.ROLES["true antenna"])
    misses = [np.hypot(*(found.antenna_in_world - truth.antenna_in_world[
        np.searchsorted(truth.antenna, found.antenna)]).T).max() for found in (chosen, solved)]
    plan.set_title(f"antennas within {misses[1]:.2f} m")
    fig.said = (f"{late} % late ranges: the antennas end up to {misses[0]:.2f} m from their true "
                f"places with the kernel “{way}”, and up to {misses[1]:.2f} m with the solver.")
    nees = evaluation.anees(solved.poses, solved.covariances, true_poses)
    side.set_title(f"NEES {nees:.1f}, {len(solved.doubts)} in doubt")
    side.set_ylim(SMALLEST_ERROR, 2 * side.dataLim.y1)
    plotting.legend_below(fig)
    return fig


def _late(seed, late, off, poses):
    """Dataset and Truth of the drive of `ranges`."""
    dataset, truth = simulate("short", seed, slip=TYPICAL_SLIP, late_ranges=late / 100)
    return misguess(dataset.without("aruco"), truth, off, seed).first(poses), truth


@lru_cache(maxsize=16)
def _by_ranges(seed, late, off, poses, way, antennas):
    """SlamResult of the drive of `ranges` by a way to treat ranges and a start of the antennas."""
    dataset, _ = _late(seed, late, off, poses)
    known = given(dataset, TYPICAL_SLIP, 1.0, 1.0)
    return result(solve_with(measure(known), ranges=way, antennas=antennas))


def _error(ax, poses, truth, role, label=None, **look):
    """Draw the position error in mm of poses (n, 3) over the pose number, on a logarithmic axis."""
    apart = np.hypot(*(poses - truth)[:, :2].T)
    plotting.curve(ax, 1e3 * apart, role, label=label, **look)
    ax.set(yscale="log", ylabel="position error (mm)")
    ax.yaxis.set_major_formatter("{x:g}")
