"""What OmniSafe does that the papers do not, as options: `compat=omnisafe`.

`preset=published` has the settings of its figures, and this its conventions. Each is an option of our
own algorithms, which can be set alone.

Source: OmniSafe @15603dd.
"""

import dataclasses
from typing import Any, NamedTuple

from jaxsafe.learn.augment import OMNISAFE_SIMMER


class Convention(NamedTuple):
    """options: which reproduce it, in algorithms that have all of them. theirs, ours: what is done."""

    options: dict[str, Any]
    theirs: str
    ours: str

    def applies(self, config: type) -> bool:
        return self.options.keys() <= {field.name for field in dataclasses.fields(config)}


OMNISAFE = (
    Convention(
        {"cost_window": 5},
        "J_c is the mean of the last 100 episodes, those of 5 iterations (of 50 in release 0.5.0 and "
        "in the published figures)",
        "of the last iteration",
    ),
    Convention(
        {"critics_stop": True},
        "where the KL stops the policy's passes over a batch, the critics' stop too",
        "critics make all of theirs",
    ),
    Convention(
        {"kl_per_action": True, "target_kl": 0.01},
        "the KL of the trust region, and H with it, is a mean over action dimensions",
        "their sum, with a bound for 2 dimensions; beside H our damping is then half as large",
    ),
    Convention(
        {"per_step": False, "violation_gain": 1.0, "margin_lr": 0.0},
        "c = J_c - cost_limit is per episode, though b is per step",
        "per step, times a gain, with a margin",
    ),
    Convention(
        {"natural": False},
        "the reward's step is sqrt(2 delta / q) g",
        "sqrt(2 delta / q) H^-1 g, the paper's",
    ),
    Convention(
        {"per_step": False, "clip_cost": False},
        "kappa max(0, E[w A_c] + J_c - cost_limit), per episode",
        "the paper's, clipped and per step",
    ),
    Convention(
        {"per_state": False},
        "the share of states within near_kl multiplies the minibatch's mean gain",
        "each state's indicator its own gain, as in the paper",
    ),
    Convention(
        {"keep_cost": True},
        "the cost that ends an episode is counted on from the last one, if time ended that",
        "each episode's own",
    ),
    Convention(
        {"full_at_end": True},
        "the value at a time limit is of a full budget, the next episode's",
        "of what the episode left",
    ),
    Convention(
        {"simmer_adds": True, "simmer_full": True, **OMNISAFE_SIMMER},
        "the controller's u is added to the last budget, with small gains, and episodes (but the first "
        "of 20) start with z = 1, the share of it",
        "u is added to the scheduled budget, with larger ones, and z is a share of the whole one",
    ),
)
COMPAT = {"none": (), "omnisafe": OMNISAFE}


def overrides(compat: str, config: type) -> dict[str, Any]:
    """The options of `config` that `compat`, a name in COMPAT, sets."""
    found: dict[str, Any] = {}
    for convention in COMPAT[compat]:
        if convention.applies(config):
            found |= convention.options
    return found
