"""How settings look: a colour an algorithm, the same in every figure, and a line and shade a setting.

The colours are those of Okabe and Ito, and of Tol, which the colour-blind tell apart. Algorithms that
share a colour are seldom in one figure. There they differ in line and shade, as settings of one
algorithm do.
"""

import zlib
from collections import Counter
from collections.abc import Iterable
from typing import Any

from matplotlib.colors import to_hex, to_rgb

from jaxsafe.report.group import Group

MARKERS = {"-": "o", "--": "s", ":": "^", "-.": "v"}  # by the kind of line that goes with it
SHADES = (0.0, 0.4, -0.4, 0.2, -0.65)  # mixed with white or, below 0, with black
DARK_SHADES = (0.0, 0.6, 0.35, 0.75, 0.2)  # of a colour that is nearly black
DARK = 0.25  # the brightness of such a colour, from 0 to 1
# the algorithms of each colour
COLORS = {
    "#0072b2": "ppo p3o sac_lag cce_pets bcq_lag osrp",
    "#e69f00": "ppo_lag npg td3_lag pets coptidice osrp_lag",
    "#009e73": "trpo_lag ppo_saute sac_pid safe_loop ccrr",
    "#d55e00": "cppo_pid trpo_saute sac cap_pets bc_safe ambs",
    "#cc79a7": "cpo ppo_simmer_pid ddpg_lag loop vae_bc",
    "#56b4e9": "pcpo trpo_simmer_pid td3 rce_pets bc",
    "#882255": "focops ppo_early_terminated td3_pid bcq",
    "#999933": "cup trpo_early_terminated ddpg_pid crr",
    "#332288": "pg pdo dreamer ddpg",
    "#8b5a2b": "trpo_pid ipo seditor",
    "#44aa99": "trpo crpo dreamer_lag",
    "#777777": "rcpo ppo_penalty dreamer_pid crabs",
}
BY_NAME = {name: color for color, names in COLORS.items() for name in names.split()}


def color_of(algo: str) -> str:
    """The colour of an algorithm. One that has none, as a user's own, gets one by its name."""
    colors = list(COLORS)
    return BY_NAME.get(algo) or colors[zlib.crc32(algo.encode()) % len(colors)]


def shaded(color: str, count: int) -> str:
    """One of the shades of a colour; the colour itself for a count of 0."""
    red, green, blue = to_rgb(color)
    dark = 0.3 * red + 0.6 * green + 0.1 * blue < DARK
    amount = (DARK_SHADES if dark else SHADES)[count % len(SHADES)]
    end, kept = (1.0 if amount > 0 else 0.0), 1 - abs(amount)
    red, green, blue = (kept * x + abs(amount) * end for x in (red, green, blue))
    return to_hex((red, green, blue))


def styles(rows: Iterable[Group]) -> dict[str, dict[str, Any]]:
    """Colour and line of each name. Give it all rows of a page, so that its figures agree.

    Where all rows are of one algorithm, its settings have colours of their own.
    """
    algos = {row.name: row.algo or row.name for row in rows}
    lines, colors = list(MARKERS), list(COLORS)
    alone = len({*algos.values()}) == 1
    found, taken = {}, Counter()
    for i, (name, algo) in enumerate(algos.items()):
        color = color_of(algo)
        if alone:
            first = colors.index(color)
            color = colors[(first + i) % len(colors)]
        count = taken[color]  # of the names before it that have this colour
        taken[color] += 1
        found[name] = {
            "color": shaded(color, count),
            "ls": lines[count % len(lines)],
        }
    return found
