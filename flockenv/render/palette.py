"""Colours and shapes that the still picture and the replay share, so that a pursuer looks alike in both."""

from __future__ import annotations

from typing import Final

__all__ = ["ARROW", "BODY_DISC", "BOND", "DART", "DART_REACH", "JUMP", "PAPER", "POINT", "ROLE_COLOURS", "mix", "rgb"]

#: role -> (on light paper, on dark paper): after Okabe and Ito's set, told apart with any colour vision
#: (jfly.uni-koeln.de/color).
ROLE_COLOURS: Final[dict[str, tuple[str, str]]] = {
    "pursuer": ("#d55e00", "#f0803c"),
    "evader": ("#0072b2", "#4fb0e8"),
    "learner": ("#e08a00", "#f2ae3d"),
    "learner 2": ("#8a4fa3", "#c08ad6"),
    "flockmate": ("#3b9bd6", "#6cbcf0"),
    "agent": ("#52637a", "#a5b3c6"),
    "agent 2": ("#b4568f", "#e08fc0"),
    "agent 3": ("#8c7a00", "#d9c63a"),
    "agent 4": ("#1f8a8a", "#5cc7c7"),
}

#: share of the colour of goals in that of ways
WAY: Final = 0.18

#: part of the picture -> (light, dark)
PAPER: Final[dict[str, tuple[str, str]]] = {
    "page": ("#f3f5f8", "#0e1218"),
    "paper": ("#ffffff", "#161c25"),
    "grid": ("#eef1f5", "#1e2631"),
    "edge": ("#c3cbd6", "#3a4657"),
    "ink": ("#1d2633", "#e6ebf2"),
    "faint": ("#6b7788", "#8e9bad"),
    "stone": ("#aab3c0", "#4a586b"),
    "rim": ("#8b96a6", "#66768c"),
    "goal": ("#009e73", "#2cc79a"),
}

#: Corners of an agent's dart in its own frame, x forward, in units of its reach.
DART: Final = ((1.0, 0.0), (-0.78, 0.66), (-0.42, 0.0), (-0.78, -0.66))

#: The least reach of a dart, as a share of the picture's width: a heading must be readable however small the body.
DART_REACH: Final = 0.0135

#: A body of at least this share of its dart's reach is a disc under the dart; a smaller one would not be seen there and
#: is a dark dot on it.
BODY_DISC: Final = 0.4

#: Width of the line of a bond, and the least radius of a dot at its end, as a share of the picture's width.
BOND: Final = 0.0022

#: The least radius of a point of an agent with a look, as a share of the picture's width.
POINT: Final = 0.0022

#: Corners of the arrow that shows a heading, x along it, in units of its length.
ARROW: Final = ((0.0, 0.035), (0.7, 0.05), (0.66, 0.16), (1.0, 0.0), (0.66, -0.16), (0.7, -0.05), (0.0, -0.035))

#: A body that moved further than this share of the world between two pictures crossed the seam or was born again.
JUMP: Final = 0.25


def rgb(colour: str) -> tuple[int, int, int]:
    """Return "#rrggbb" as three numbers 0..255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def mix(colour: str, ground: str, share: float) -> tuple[int, int, int]:
    """Return `share` (0..1) of `colour` laid over `ground`."""
    r, g, b = (round(share * top + (1.0 - share) * below) for top, below in zip(rgb(colour), rgb(ground), strict=True))
    return r, g, b
