"""Draws the figures of the Explore sections at the end of the notebooks; `controls` moves them.

A figure's attribute `said` (str) says what it shows. Chapters 2 to 4 draw a simulated
drive, or the first part of a dataset. Errors that the controls make are added to those of its
files. Without truth a dataset is compared with the chapter's solution of the whole drive.
"""

from dataclasses import replace
from functools import lru_cache

import gtsam
import numpy as np

from slamlib import evaluation, localization, odometry, se2
from slamlib.increments import TYPICAL_SLIP
from slamlib.notebook import plotting
from slamlib.notebook.controls import SIMULATED, choice, drive_choice, show_with_controls, slider
from slamlib.notebook.parts import (
    camera_reach,
    data_sentences,
    error_curve,
    figure_with_reference,
    finished,
    first_part,
    moving_drive,
    nees_text,
    reference_of,
    simulated,
)
from slamlib.simulation import delay, misguess, mislabel
from slamlib.slam.fit import optimize
from slamlib.slam.initialization import odometry_state, trilaterated_antennas
from slamlib.slam.measurements import (
    AcceptedMeasurements,
    Noise,
    measure,
    with_known,
    with_known_noise,
)
from slamlib.slam.pipeline import fit_from_odometry
from slamlib.slam.problem import build_problem
from slamlib.slam.result import slam_result
from slamlib.studies.kernels import solve_with
from slamlib.studies.starts import LANDMARKS, guessed_antennas

__all__ = ["KERNEL_SCALES", "SIMULATED", "camera_reach", "choice", "draw_cameras", "draw_graphs",
           "draw_ranges", "draw_wheels", "drive_choice", "moving_drive", "show_with_controls",
           "slider"]

MIN_WRONG_DISTANCE = 0.5     # m, error of a marker that is mapped at a wrong place
# Scales of the Cauchy kernel in standard deviations, by name.
KERNEL_SCALES = {f"{scale} σ": scale for scale in (1, 3, 10, 30, 100)} | {"none": None}


def draw_wheels(drive, right, left, base, sigma_radii, sigma_base, probability, count):
    """Chapter 1: odometry with other wheel parameters, and the ellipses of equation 2. The figure.

    Parameters
    ----------
    drive : Drive
    right, left, base : errors of R_R, R_L and b in units of their nominal standard deviations.
    sigma_radii, sigma_base : factors on the standard deviations of equation 2.
    probability : percent, of the ellipses.
    count : number of ellipses.
    """
    part = first_part(drive.dataset)
    ticks, v = part.ticks, part.vehicle
    other = odometry.dead_reckoning(ticks, v.with_deviation(np.array([right, left, base])))
    poses, covariances = odometry.equation2(ticks, replace(
        v, sigma_right_radius=v.sigma_right_radius * sigma_radii,
        sigma_left_radius=v.sigma_left_radius * sigma_radii,
        sigma_wheelbase=v.sigma_wheelbase * sigma_base))
    some, color = plotting.equidistant(poses, count), plotting.ROLES["odometry"]["color"]
    name = f"{probability} % by equation 2"
    fig, ((plan,), (side,)) = plotting.panels(2, height=3.6)
    plotting.trajectory(plan, poses, "odometry", "nominal wheels")
    plotting.ellipses(plan, poses[some], covariances[some], color, probability / 100, name)
    plotting.trajectory(plan, other, "alternative", "wheels of the sliders")
    plan.set_title(plotting.literal(drive.name))
    k = np.sqrt(-2 * np.log(1 - probability / 100))
    longest = k * np.sqrt(np.linalg.eigvalsh(covariances[:, :2, :2])[:, 1])
    side.fill_between(np.arange(len(poses)) + 1, longest, color=color, alpha=0.18, linewidth=0,
                       label="semi-major axis")
    plotting.curve(side, np.hypot(*(other - poses)[:, :2].T), "alternative",
                   label="wheels of the sliders")
    if drive.truth is not None:
        true = drive.truth.poses[:len(ticks)]
        plotting.trajectory(plan, true, "truth")
        plotting.curve(side, np.hypot(*(true - poses)[:, :2].T), "truth")
        plan.set_title(f"{plotting.literal(drive.name)}: ATE {evaluation.ate(other, true):.3f} m")
    side.set(ylabel="distance from nominal (m)", ylim=(0, None))
    plotting.legend_below(fig)
    fig.said = _said_of_wheels(v, np.array([right, left, base]), poses[-1], other[-1])
    fig.said += data_sentences(drive, part)
    return fig


def _said_of_wheels(vehicle, deviation, end, other):
    """Sentence (str) on the last pose (3,), moved by errors (3,) of the wheels in sigmas."""
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


def draw_cameras(full, drive, seed, every, reach, claimed):
    """Chapter 2: localization from fewer sightings, by markers alone and fused. The figure.

    Parameters
    ----------
    full : dict by the drives' names of Fusion, of all measurements.
    drive : Drive, or SIMULATED.
    seed : of a simulated drive of the short path.
    every : one frame of the camera in so many is used.
    reach : m, largest distance of a marker that is seen.
    claimed : factor on the reported standard deviations of the sightings, not on their errors.
    """
    slip = TYPICAL_SLIP if drive.made_up else full[drive.name].slip
    if drive.made_up:
        drive = simulated(seed, slip=slip)
    dataset = first_part(drive.dataset, "aruco")
    reference = reference_of(drive, full, "this chapter's fusion", len(dataset.ticks))
    true, aruco = reference.poses, dataset.aruco
    used = np.isin(aruco.pose, np.unique(aruco.pose)[::every])
    aruco = aruco.select(used & (np.hypot(*aruco.marker_in_vehicle[:, :2].T) <= reach))
    aruco = replace(aruco, covariance=aruco.covariance * claimed**2)
    fig, plan, side = figure_with_reference(reference)
    path = odometry.dead_reckoning(dataset.ticks, dataset.vehicle)
    plotting.trajectory(plan, path, "odometry")
    error_curve(side, path, reference, "odometry")
    fig.said = "Without a sighting only the odometry is left."
    if len(aruco.pose):
        fused = localization.fuse(replace(dataset, aruco=aruco), slip=slip)
        alone = localization.localize(aruco)
        known = np.isfinite(alone.poses[:, 0])
        poses = se2.compose(true[alone.frame[known][0]], alone.poses)
        plotting.trajectory(plan, poses, "aruco", "markers alone")
        plotting.trajectory(plan, fused.poses, "fused")
        k = plotting.enlargement(fused.poses, fused.covariances)
        some, color = plotting.equidistant(fused.poses, 10), plotting.ROLES["fused"]["color"]
        plotting.ellipses(plan, fused.poses[some], fused.covariances[some], color, enlarged=k)
        error_curve(side, poses, reference, "aruco", "markers alone", alone.frame)
        error_curve(side, fused.poses, reference, "fused")
        plan.set_title(f"{len(aruco.pose)} sightings (ellipses × {k})")
        fig.said = f"Markers alone locate {np.count_nonzero(known)} of {len(known)} frames."
        nees = evaluation.anees(fused.poses[alone.frame], fused.covariances[alone.frame],
                                true[alone.frame]) if reference.is_truth else np.nan
        side.set_title(f"fused: {fused.rejected} rejected"
                       + (f", NEES {nees:.1f}" if np.isfinite(nees) else ""))
        if np.isfinite(nees):
            low, high = evaluation.nees_band(1)
            fig.said += (f" The NEES of the fusion is {nees:.1f}; on single drives consistent "
                         f"covariances give {low:.1f} to {high:.1f} in 95 % of the cases.")
    return finished(fig, drive, dataset, reference)


def draw_graphs(full, drive, seed, slip, assumed, wrong, kernel, start):
    """Chapter 3: the graph solved with one Cauchy kernel, and with kernels that narrow. The figure.

    Parameters
    ----------
    full : dict by the drives' names of SlamResult, of all measurements.
    drive : Drive, or SIMULATED, a simulated drive of the short path.
    seed : of the simulated drive, or of the wrong labels that are added to a dataset.
    slip, assumed : mm after 1 m, of the simulated drive and of the graph.
    wrong : percent of the sightings with a wrong label.
    kernel : name in KERNEL_SCALES.
    start : name in starts.LANDMARKS, for the single kernel.
    """
    model = "arc" if drive.made_up else full[drive.name].model
    drive, m, solved = _solved_with_markers(drive, model, seed, slip, assumed, wrong)
    reference = reference_of(drive, full, "problem 3's solution", len(m.dataset.ticks))
    label, compared = reference.label, reference.solution
    scale = KERNEL_SCALES[kernel]
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(scale) if scale else None
    problem = replace(build_problem(m, model, with_known(Noise(), m.dataset.vehicle)),
                      accepted=AcceptedMeasurements(
                          measurements=m, weight=m.unit_weights, sighting_kernel=cauchy))
    single = optimize(problem, odometry_state(m, model, markers=LANDMARKS[start])).state
    fig, plan, side = figure_with_reference(reference)
    plotting.trajectory(plan, single.poses, "alternative", "single kernel")
    plotting.trajectory(plan, solved.poses, "slam", "rounds of kernels")
    places = plotting.places_by_id(compared.marker, compared.marker_in_world[:, :2], m.marker)
    wide = []
    for marker, in_world, look in ((m.marker, single.markers, "alternative"),
                                   (solved.marker, solved.marker_in_world, "slam")):
        ends = np.stack([places[np.isin(m.marker, marker)], in_world[:, :2]])
        plan.plot(*ends.T.swapaxes(1, 2), color=plotting.ROLES[look]["color"], linewidth=1.2)
        wide.append(np.count_nonzero(np.hypot(*(ends[1] - ends[0]).T) > MIN_WRONG_DISTANCE))
    places = places[np.isfinite(places[:, 0])]
    fig.said = f"{wrong} % wrong labels{'' if drive.made_up else ' added'}."
    if len(places):
        their = "their true place" if reference.is_truth else f"where {label} has them"
        fig.said = (f"{fig.said[:-1]}: the single kernel maps {wide[0]} of {len(places)} markers "
                    f"more than {MIN_WRONG_DISTANCE} m from {their}, the rounds {wide[1]}.")
        plan.plot(*places.T, **plotting.ROLES["marker"],
                  label="true markers" if reference.is_truth else f"markers: {label}")
    around = np.concatenate([places, reference.poses[:, :2]])
    low, high = around.min(0) - 0.5, around.max(0) + 0.5
    plan.set_aspect("equal", adjustable="box")          # markers far from the map are cut off
    plan.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    plan.set_title(f"{len(solved.rejected)} sightings")
    error_curve(side, single.poses, reference, "alternative", "single kernel", m.frame)
    error_curve(side, solved.poses, reference, "slam", "rounds of kernels")
    side.set_title(f"rounds: {np.count_nonzero(solved.rejected)} rejected"
                   + nees_text(solved, reference))
    return finished(fig, drive, m.dataset, reference)


@lru_cache(maxsize=8)
def _solved_with_markers(drive, model, seed, slip, assumed, wrong):
    """Drive, Measurements, and SlamResult by rounds of kernels, of the values of `graphs`."""
    if drive.made_up:
        drive = simulated(seed, slip=1e-3 * slip, mislabelled=wrong / 100)
        dataset = drive.dataset
    else:
        dataset = mislabel(first_part(drive.dataset, "aruco"), wrong / 100, seed)
    m = measure(with_known_noise(dataset.without("uwb"), 1e-3 * assumed, 1.0, 1.0))
    return drive, m, slam_result(fit_from_odometry(m, model))


def draw_ranges(full, drive, seed, late, off, part, range_kernel):
    """Chapter 4: ranges and odometry, by one kernel from the guess, and by the default. The figure.

    Parameters
    ----------
    full : dict by the drives' names of SlamResult, of all measurements.
    drive : Drive, or SIMULATED, a simulated drive of the short path.
    seed : of the simulated drive, or of the errors that are added to a dataset.
    late : percent of the ranges that are too long.
    off : m, error of the antenna guesses, each in a random direction.
    part : percent of the poses, the first ones, that are used.
    range_kernel : name in kernels.RANGE_METHODS.
    """
    known = (TYPICAL_SLIP, "arc") if drive.made_up else \
        (full[drive.name].slip, full[drive.name].model)
    drive, m, chosen = _solved_with_ranges(drive, *known, seed, late, off, part,
                                           range_kernel, guessed_antennas)
    *_, solved = _solved_with_ranges(drive, *known, seed, late, off, part, "asymmetric Tukey",
                            trilaterated_antennas)
    reference = reference_of(drive, full, "problem 4's solution", len(m.dataset.ticks))
    label, compared = reference.label, reference.solution
    places = plotting.places_by_id(compared.antenna, compared.antenna_in_world, m.antenna)
    fig, plan, side = figure_with_reference(reference)
    for found, look, name in ((chosen, "alternative", "chosen kernel"),
                              (solved, "slam", "solver")):
        plotting.trajectory(plan, found.poses, look, name)
        ends = np.stack([m.guess, found.antenna_in_world])
        plan.plot(ends[..., 0], ends[..., 1], "o-", markevery=[1], markersize=4, linewidth=1.2,
                  color=plotting.ROLES[look]["color"])
        error_curve(side, found.poses, reference, look, name)
    plan.plot(*m.dataset.antenna_guess.position.T, label="antennas: guess",
              **plotting.ROLES["guess"])
    fig.said = f"{late} % late ranges{'' if drive.made_up else ' added'}."
    if np.isfinite(places).any():
        plan.plot(*places.T, label=f"antennas: {label}",
                  **plotting.ROLES["true antenna" if reference.is_truth else "antenna"])
        misses = [np.nanmax(np.hypot(*(found.antenna_in_world - places).T))
                  for found in (chosen, solved)]
        plan.set_title(f"antennas within {misses[1]:.2f} m")
        their = "their true places" if reference.is_truth else f"where {label} has them"
        fig.said = (f"{fig.said[:-1]}: the antennas end up to {misses[0]:.2f} m from {their} with "
                    f"the kernel “{range_kernel}”, and up to {misses[1]:.2f} m with the solver.")
    side.set_title(f"{len(solved.doubts)} in doubt" + nees_text(solved, reference))
    return finished(fig, drive, m.dataset, reference)


@lru_cache(maxsize=16)
def _solved_with_ranges(drive, slip, model, seed, late, off, part, range_kernel, antennas):
    """Drive, Measurements and SlamResult of the values of `ranges` and a start of the antennas."""
    if drive.made_up:
        drive = simulated(seed, slip=slip, late_ranges=late / 100)
        dataset, position = drive.dataset, drive.truth.antenna_in_world
    else:
        dataset = delay(first_part(drive.dataset, "uwb"), late / 100, seed)
        position = dataset.antenna_guess.position
    dataset = misguess(dataset.without("aruco"), position, off, seed)
    dataset = first_part(dataset.first(-(-len(dataset.ticks) * part // 100)), "uwb")
    m = measure(with_known_noise(dataset, slip, 1.0, 1.0))
    return drive, m, slam_result(solve_with(m, ranges=range_kernel, antennas=antennas, model=model))
