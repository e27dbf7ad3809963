"""What becomes of a key of OmniSafe: the kinds of rules that the tables of the families are made of.

Rule("algo.clip")                 another name
computed("algo.horizon", batch)   options that are computed, perhaps from several keys
switch("algo.max_grad_norm", inf) where false means a value of an option
named("algo.init", {...})         words that have other names here
always(True)                      no option: jaxsafe does so, and nothing else
ignored()                         no option: nothing is lost, whatever the value
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxsafe.config import Amount, convert


class Facts(NamedTuple):
    """What the meaning of a key may depend on."""

    values: Mapping[str, Any]  # all keys of the file
    options: Mapping[str, Any]  # of our algorithm, with the preset's values: 'algo.epochs', ...
    repeat: int = 1  # raw steps in a step of the planner

    @property
    def trust_region(self) -> bool:
        """Whether the policy moves by natural gradients, not by epochs of Adam."""
        return "algo.epochs" not in self.options

    def whole(self, key: str, default: int) -> int:
        return convert(self.values.get(key, default), Amount, key)

    def real(self, key: str, default: float) -> float:
        return convert(self.values.get(key, default), float, key)


# (value, facts) -> options with their values; {} if jaxsafe does so anyway, None if it cannot
Translate = Callable[[Any, Facts], dict[str, Any] | None]


class Rule(NamedTuple):
    """What becomes of a key of OmniSafe.

    ours: the options, separated by spaces; '' if there is none.
    note: how, or why not.
    turn: makes options, of which those in `ours` count. None: each of `ours` gets the value as it is.
    same: for a key without an option, the values that jaxsafe matches anyway; None: all of them.
    """

    ours: str = ""
    note: str = ""
    turn: Translate | None = None
    same: tuple[Any, ...] | None = ()

    def options(self, value: Any, facts: Facts) -> dict[str, Any] | None:
        names = self.ours.split()
        if self.turn is None:
            return dict.fromkeys(names, value)
        found = self.turn(value, facts)
        return found and {k: v for k, v in found.items() if k in names}

    def loses(self, value: Any) -> bool:
        """Whether a key without an option asks for something else than what jaxsafe does."""
        return self.same is not None and value not in self.same


def computed(ours: str, turn: Translate, note: str = "") -> Rule:
    return Rule(ours, note, turn)


def switch(option: str, off: float, note: str) -> Rule:
    """For OmniSafe's switches: on, another key says how much."""
    return Rule(option, note, lambda on, facts: {} if on else {option: off})


def named(option: str, names: dict[str, str], note: str) -> Rule:
    def turn(word: Any, facts: Facts) -> dict[str, Any] | None:
        return {option: names[word]} if isinstance(word, str) and word in names else None

    return Rule(option, note, turn)


def always(*values: Any, note: str) -> Rule:
    return Rule("", note, same=values)


def ignored(note: str) -> Rule:
    return Rule("", note, same=None)
