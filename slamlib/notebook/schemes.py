"""Draws schemes of the factor graphs of problems 3 and 4."""

import numpy as np

from slamlib.notebook.plotting import ROLES


def slam_graph(ax, count, sightings, markers, ranges=(), antennas=()):
    """Draw a scheme of the graph of problem 3, or with ranges that of problem 4; returns `ax`.

    `count` vehicle poses stand in a row, the markers above, the wheel parameters w and the antennas
    below; these are lists of labels. `sightings` and `ranges` are lists of (pose, landmark).
    """
    poses = np.array([(i, 0.0) for i in range(count)])
    above, below = (_places_in_row(count, len(names), y)
                    for names, y in ((markers, 1.3), (antennas, -2.0)))
    wheel = np.array([poses[:, 0].mean(), -0.8])
    for i, j in sightings:
        _draw_factor(ax, [poses[i], above[j]], ROLES["aruco"]["color"])
    for i, k in ranges:
        _draw_factor(ax, [poses[i], below[k]], ROLES["slam_uwb"]["color"], share=0.75)
    for i in range(count - 1):
        _draw_factor(ax, [poses[i], poses[i + 1], wheel], ROLES["odometry"]["color"])
    for place, side in [(poses[0], -0.3), (wheel, -0.3), *((place, 0.3) for place in below)]:
        _draw_factor(ax, [place, place + [side, 0.0]], "black", share=1.0)
    for place, name, color in [
            *((place, f"$X_{i + 1}$", "white") for i, place in enumerate(poses)),
            *((place, f"$L_{{{name}}}$", "#dddddd") for place, name in zip(above, markers)),
            *((place, f"$A_{{{name}}}$", "#cfe8f7") for place, name in zip(below, antennas)),
            (wheel, "$w$", "#ffe0b0")]:
        ax.text(*place, name, ha="center", va="center", fontsize=11, zorder=4,
                bbox=dict(boxstyle="circle,pad=0.25", facecolor=color, edgecolor="black"))
    ax.set(xlim=(-0.8, count - 0.2), ylim=(-2.5 if len(antennas) else -1.3, 1.8))
    ax.axis("off")
    return ax


def _places_in_row(count, landmarks, y):
    """Places (landmarks, 2) at equal distances in a row above or below `count` poses."""
    x = np.linspace(-0.7, count - 0.3, landmarks + 2)[1:-1]
    return np.column_stack([x, np.full(landmarks, y)])


def _draw_factor(ax, ends, color, share=0.5):
    """Draw a factor between `ends`; of two, its square is at a share of the line to the second."""
    middle = np.mean(ends, axis=0) if len(ends) > 2 else (1 - share) * ends[0] + share * ends[1]
    for end in ends:
        ax.plot(*np.stack([end, middle]).T, color=color, linewidth=0.9, zorder=1)
    ax.plot(*middle, "s", color=color, markersize=4.5, zorder=2)
