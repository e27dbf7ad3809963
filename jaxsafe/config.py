"""Configs: frozen dataclasses whose floats are pytree leaves, read strictly from plain values."""

import contextlib
import dataclasses
import difflib
import functools
import importlib
import math
import numbers
import sys
import types
import typing
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, dataclass_transform

import jax

T = TypeVar("T")
LISTED = 30  # names that a message lists
OWN_CODE = "; your own is MODULE:NAME"


class ConfigError(ValueError):
    """A setting that cannot be used. The message is one line for the user."""


class UnnamedCode(ConfigError):
    """Code of the user's that a file names and the user has not named."""

    def __init__(self, kind: str, name: str):
        super().__init__(
            f"{name} is code, which is not imported because a file names it; if you trust it, add "
            f"{kind}={name}"
        )


class MissingObject(ConfigError):
    """An environment or algorithm of the user's that a run was trained with, which is not given."""

    def __init__(self, kind: str, name: str):
        super().__init__(
            f"the run was trained with {kind}={name}, which jaxsafe does not have; if it is an object "
            f"of your program, open the run from Python with it: jaxsafe.Run(FOLDER, {kind}=OBJECT)"
        )


def one_line(error: BaseException) -> str:
    """The first line of what an error says, or its kind if it says nothing."""
    lines = (line.strip() for line in str(error).splitlines())
    return next((line for line in lines if line), type(error).__name__)


# ---- bounds ----------------------------------------------------------------------------------


class Bounds(NamedTuple):
    """Between which numbers a value lies, both included: `clip: Annotated[float, Bounds(0, 1)] = 0.2`.

    NaN is never within them. inf: what infinity means where it is allowed, as in 'no bound'.
    """

    low: float
    high: float
    inf: str = ""

    def __str__(self) -> str:
        allowed = f", or inf ({self.inf})" if self.inf else ""
        return f"between {self.low:.12g} and {self.high:.12g}{allowed}"

    def hold(self, value: float) -> bool:
        return self.low <= value <= self.high or (value == math.inf and bool(self.inf))


FINITE = Bounds(-sys.float_info.max, sys.float_info.max)  # of a number without bounds of its own
# What several configs have. A field with bounds of its own writes them out.
Amount = Annotated[int, Bounds(1, 2**24)]  # of what exists side by side
RunSteps = Annotated[int, Bounds(1, 10**15)]  # of a whole run
Iterations = Annotated[int, Bounds(1, 10_000)]  # of a solver, of passes over a batch, of a window
Pixels = tuple[Annotated[int, Bounds(1, 10_000)], Annotated[int, Bounds(1, 10_000)]]  # width, height
Period = Annotated[int, Bounds(0, 10**15)]  # steps or iterations; 0 is never
Devices = Annotated[int, Bounds(1, 2**16)]  # or processes
EpisodeCount = Annotated[int, Bounds(1, 10**6)]
Index = Annotated[int, Bounds(0, 10**9)]  # of a policy, of a setting
Port = Annotated[int, Bounds(1, 65535)]
Seed = Annotated[int, Bounds(0, 2**31 - 1)]
Units = Annotated[int, Bounds(1, 2**16)]  # of a layer
Share = Annotated[float, Bounds(0, 1)]  # a discount, a probability, a part of a whole
Rate = Annotated[float, Bounds(0, 10)]  # the step of an optimiser
Weight = Annotated[float, Bounds(0, 1e6)]  # a gain, a price, a limit, a cost
Real = Annotated[float, Bounds(-1e6, 1e6)]  # a reward, and whatever else may be negative
Cap = Annotated[float, Bounds(0, 1e6, inf="no bound")]  # the highest price
KLStop = Annotated[float, Bounds(0, 1e3, inf="never")]  # nats, beyond which passes stop
Norm = Annotated[float, Bounds(1e-9, 1e9, inf="no bound")]  # the longest gradient
EndOfDecay = Annotated[float, Bounds(1, 1e15, inf="the end of the run")]  # an iteration


# ---- configs ---------------------------------------------------------------------------------


@dataclass_transform(frozen_default=True, kw_only_default=True)
def config(cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass and a pytree: floats, alone or by name, are leaves, others static.

    A sweep over `cost_limit` or `lr` is then a `vmap`; a new value of an int, bool or str
    field is a new program.
    """
    cls = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
    leaves = fields_of(cls, float, dict[str, float] | None)
    static = [f.name for f in dataclasses.fields(cls) if f.name not in leaves]  # type: ignore[arg-type]
    jax.tree_util.register_dataclass(cls, data_fields=leaves, meta_fields=static)
    return cls


@functools.cache
def hints_of(cls: type, bounds: bool = False) -> dict[str, Any]:
    """The type of each field, with its bounds if asked for."""
    return typing.get_type_hints(cls, include_extras=bounds)


def fields_of(cls: type, *kinds: Any) -> list[str]:
    hints = hints_of(cls)
    return [f.name for f in dataclasses.fields(cls) if hints[f.name] in kinds]  # type: ignore[arg-type]


def is_float(cls: type, name: str) -> bool:
    """Whether `name` is a float of the config: 'clip', or by name as in 'cost_limits.hazards'."""
    field, _, inside = name.partition(".")
    return field in fields_of(cls, dict[str, float] | None if inside else float)


def flat(values: dict[str, Any]) -> dict[str, Any]:
    """{'algo.clip': 0.2, 'algo.cost_limits.hazards': 10.0, ...} of dicts in dicts."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        inside = flat(value) if isinstance(value, dict) else {}
        out |= {f"{name}.{k}": v for k, v in inside.items()} or {name: value}
    return out


def nearest(name: str, names: typing.Iterable[str], more: str = "") -> str:
    """'; did you mean X?' for the closest of `names`, or, if none is close, some of them and `more`."""
    names = sorted(names, key=str.swapcase)  # small letters first
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    if not close:
        others = f" and {len(names) - LISTED} others" * (len(names) > LISTED)
        return f"; valid: {', '.join(names[:LISTED])}{others}{more}"

    def likeness(candidate: str) -> tuple[float, int, int]:
        ratio = difflib.SequenceMatcher(None, candidate, name).ratio()
        shared = Counter(candidate) & Counter(name)  # of equal ratios, letters swapped come first
        return ratio, shared.total(), -len(candidate)

    return f"; did you mean {max(close, key=likeness)!r}?"


def from_dict(cls: type[T], values: dict[str, Any], where: str = "") -> T:
    """Build the dataclass `cls` from plain values, with every name and type checked.

    Args:
        cls: a dataclass.
        values: field name -> value, as read from YAML or a command line.
        where: what to call the field in messages, e.g. 'env.'.
    Raises:
        ConfigError: an unknown name (with the nearest valid one), a value of the wrong type or out of
            its bounds.
    """
    hints = hints_of(cls, bounds=True)
    names = [f.name for f in dataclasses.fields(cls) if f.init]  # type: ignore[arg-type]
    for name in values:
        if name not in names:
            raise ConfigError(f"unknown option {where}{name}{nearest(name, names)}")
    return cls(**{k: convert(v, hints[k], f"{where}{k}") for k, v in values.items()})


def check_values(cfg: Any, where: str = "") -> None:
    """Raise ConfigError for a number of `cfg`, a dataclass, out of its bounds, or for an unknown word.

    JAX's traced values are not checked.
    """
    hints = hints_of(type(cfg), bounds=True)
    for name in (f.name for f in dataclasses.fields(cfg)):
        if isinstance(value := getattr(cfg, name), numbers.Real | tuple | str):
            convert(value, hints[name], f"{where}{name}")


def convert(value: Any, kind: Any, name: str) -> Any:
    """`value` as the annotated type `kind`, within its bounds: the one check of every setting.

    Whole floats serve as ints, lists as tuples, NumPy's numbers as Python's. A float without bounds is
    finite all the same.
    """
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any:
        return value
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        *others, last = (a for a in args if a is not type(None))
        for option in others:
            try:
                return convert(value, option, name)
            except ConfigError:
                continue
        if not others:
            return convert(value, last, name)
        with contextlib.suppress(ConfigError):  # the error at the end names all options
            return convert(value, last, name)
    elif origin is tuple and isinstance(value, list | tuple):
        if args[-1] is Ellipsis:
            return tuple(convert(v, args[0], f"{name}[{i}]") for i, v in enumerate(value))
        if len(value) == len(args):
            return tuple(
                convert(v, a, f"{name}[{i}]") for i, (v, a) in enumerate(zip(value, args, strict=True))
            )
    elif origin is dict and isinstance(value, dict) and value:
        return {str(k): convert(v, args[1], f"{name}.{k}") for k, v in value.items()}
    elif origin is typing.Literal:
        for option in args:  # the listed one: 2, where 2.0 came
            if value == option:
                return option
        raise ConfigError(f"{name}={shown(value)}{nearest(str(value), map(str, args))}")
    elif (kind is bool and isinstance(value, bool)) or (kind is str and isinstance(value, str)):
        return value
    elif (number := as_number(value, kind)) is not None:
        return number
    raise ConfigError(f"{name}={shown(value)}: expected {kind_in_words(kind)}")


def as_number(value: Any, kind: Any) -> Any:
    """`value` as int, float or one of them within Bounds; None if it is not of that kind."""
    kind, bounds = typing.get_args(kind) if typing.get_origin(kind) is Annotated else (kind, FINITE)
    if kind not in (int, float) or not isinstance(value, numbers.Real) or isinstance(value, bool):
        return None
    with contextlib.suppress(OverflowError, ValueError):  # 10**400 is no float, inf and NaN no int
        number = kind(value)  # type: ignore[call-arg]
        if bounds.hold(number) and (kind is float or number == value):
            return number
    return None


def shown(value: Any) -> str:
    """What came, short enough for a line."""
    if isinstance(value, int) and value.bit_length() > 200:
        return "a number of many digits"
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def kind_in_words(kind: Any) -> str:
    """The annotated type in a user's words."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return f"{kind_in_words(args[0])} {args[1]}"
    if origin in (typing.Union, types.UnionType):
        return " or ".join("null" if a is type(None) else kind_in_words(a) for a in args)
    if origin is tuple and args[-1] is Ellipsis:
        return f"a list, of which each is {kind_in_words(args[0])}"
    if origin is dict:
        return f"names with {kind_in_words(args[1])} each, as in {{name: 5}}"
    if origin is tuple:
        return f"{len(args)} values ({', '.join(map(kind_in_words, args))})"
    return {int: "a whole number", float: "a number", str: "a string", bool: "true or false"}.get(
        kind, str(kind)
    )


def import_object(option: str, address: str) -> Any:
    """What 'module:name' names, imported from the working directory or from what is installed.

    This executes the module, so an address comes from the user, never from a file.

    Args:
        option: whose value the address is, for messages: 'env' or 'algo'.
    Raises:
        ConfigError: no such module, or nothing of that name in it.
    """
    module, _, name = address.partition(":")
    if not (module and name):
        raise ConfigError(f"{option}={address}: expected module:name")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if not error.name or not f"{module}.".startswith(f"{error.name}."):  # a module that it imports
            raise
        raise ConfigError(f"{option}={address}: no module {module!r} in {here} or installed") from error
    if name not in vars(found):
        public = [key for key in vars(found) if not key.startswith("_")]
        raise ConfigError(f"{option}={address}: {module} has no {name!r}{nearest(name, public)}")
    return vars(found)[name]
