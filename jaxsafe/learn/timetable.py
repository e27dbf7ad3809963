"""The clock of algorithms with a replay: what an iteration consists of, and what is due when.

    iteration       one `update`: some rounds, after which models are refitted and prices move
    round           some rows, and then some gradient steps
    row             one step of every environment, written into the ring as one row
    gradient step   on one batch from the ring

The training loop counts iterations. Everything else is a function of that count, so it is the same for
all members of a `vmap`. With `num_envs` environments on all devices together, a row is `num_envs`
environment steps, and a round takes

    gradient steps = replay_ratio * num_envs * learn_every / batch
"""

import math
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.config import (
    Amount,
    Bounds,
    ConfigError,
    EndOfDecay,
    Iterations,
    Share,
    Weight,
    check_values,
    config,
)
from jaxsafe.learn.batch import device_count
from jaxsafe.learn.replay import Span, held, ring_rows
from jaxsafe.learn.rollout import check_steps
from jaxsafe.types import Shared

BATCH = 4096  # transitions of a gradient step, where the user does not say
BATCHES = range(64, 4 * BATCH + 1)  # where BATCH does not fit, the nearest of these that does


@config
class ReplayConfig:
    """What all algorithms with a replay share."""

    # Environments side by side, of all devices together. OmniSafe has 1.
    num_envs: Amount = 1024
    horizon: Amount = 16  # Steps of each environment in an update.
    stagger: bool = True  # Whether the first episodes start at different ages, so that ends spread out.
    # The iteration at which whatever decays reaches 0. inf: the last one of `total_steps`.
    total_iterations: EndOfDecay = float("inf")
    # Transitions kept, rounded to whole updates. As in OmniSafe.
    replay_size: Annotated[int, Bounds(1, 2**31 - 1)] = 1_000_000
    # Environment steps with random actions and without learning, as in OmniSafe.
    learning_starts: Annotated[int, Bounds(0, 2**31 - 1)] = 10_000
    discount: Share = 0.99  # The discount of rewards, as in OmniSafe.
    cost_discount: Share = 0.99  # The discount of costs, as in OmniSafe.
    # The undiscounted cost that an episode may have. Unconstrained algorithms only draw it in plots.
    cost_limit: Weight = 25.0


@config
class RoundConfig(ReplayConfig):
    """What algorithms share that take gradient steps on rows of a replay."""

    # Steps of each environment between two rounds of gradient steps.
    learn_every: Amount = 1
    replay_ratio: Amount = 16  # Transitions replayed for each environment step. OmniSafe has 256.
    # Transitions of a gradient step, of all devices together. null: 4096 or, where that makes no whole
    # number of gradient steps, the nearest size that does. OmniSafe has 256.
    batch_size: Amount | None = None
    n_step: Iterations = 1  # Rewards summed before the critics' value. OmniSafe has 1.


class Round(NamedTuple):
    """Where a round stands in the run.

    iteration: int32 [], iterations before this one.
    before, after: Span, what the ring holds before and after the rows of the round are written.
    warming_up: bool [], whether its actions are random.
    ready: bool [], whether its rows are followed by gradient steps.
    first_step: int32 [], the number, in the run, of the first of these steps.
    """

    iteration: jax.Array
    before: Span
    after: Span
    warming_up: jax.Array
    ready: jax.Array
    first_step: jax.Array


class Timetable(NamedTuple):
    """What an iteration consists of.

    rounds: of an iteration.
    rows, gradient_steps: of a round.
    batch: transitions of a gradient step, on this device.
    ring: rows that the ring has room for.
    warm_up: rows before the first gradient step.
    """

    rounds: int
    rows: int
    gradient_steps: int
    batch: int
    ring: int
    warm_up: int

    def at(self, number: jax.Array | int, shared: Shared) -> Round:
        """Round `number` of the present iteration.

        A run that was resumed without its replay has warmed up, but is not ready until the ring holds
        as much again.
        """
        iteration, since = jnp.asarray(shared.iteration), shared.since
        block = self.rounds * self.rows  # rows of an iteration
        before = number * self.rows  # rows of this iteration
        after = before + self.rows
        return Round(
            iteration=iteration,
            before=held(self.ring, block, before, iteration, since),
            after=held(self.ring, block, after, iteration, since),
            warming_up=iteration * block + before < self.warm_up,
            ready=(iteration - since) * block + after >= max(self.warm_up, 2),
            first_step=(iteration * self.rounds + number) * self.gradient_steps,
        )


def timetable_of(cfg: ReplayConfig, axis_name: str | None) -> Timetable:
    """The timetable for `cfg.num_envs` environments on each device.

    Raises:
        ConfigError: sizes out of their bounds, or that do not fit each other.
    """
    check_values(cfg)
    check_steps(cfg.num_envs, cfg.horizon)
    devices = device_count(axis_name)
    num_envs = cfg.num_envs * devices
    ring = ring_rows(cfg.replay_size, num_envs, cfg.horizon)
    warm_up = -(-cfg.learning_starts // num_envs)
    if not isinstance(cfg, RoundConfig):  # it takes no gradient steps on rows of the replay
        return Timetable(
            rounds=1, rows=cfg.horizon, gradient_steps=0, batch=0, ring=ring, warm_up=warm_up
        )
    check_rounds(cfg)
    batch = batch_of(cfg, num_envs, devices)
    gradient_steps = steps_of_round(cfg, num_envs, batch)
    if batch > ring * num_envs or ring <= cfg.n_step:
        raise ConfigError(
            f"replay_size={cfg.replay_size} holds {ring} steps of {num_envs} environments: expected "
            f"at least batch_size={batch} transitions and more than n_step={cfg.n_step} steps"
        )
    return Timetable(
        rounds=cfg.horizon // cfg.learn_every,
        rows=cfg.learn_every,
        gradient_steps=gradient_steps,
        batch=batch // devices,
        ring=ring,
        warm_up=warm_up,
    )


def check_rounds(cfg: RoundConfig) -> None:
    """Refuse rounds that do not fill an iteration."""
    if cfg.horizon % cfg.learn_every:
        raise ConfigError(
            f"learn_every={cfg.learn_every}: expected a divisor of horizon={cfg.horizon}; "
            f"the nearest is {closest(divisors(cfg.horizon), cfg.learn_every)}"
        )


def batch_of(cfg: RoundConfig, num_envs: int, devices: int) -> int:
    """The transitions of a gradient step, of all devices together.

    Raises:
        ConfigError: `batch_size` does not split over the devices.
    """
    if cfg.batch_size is None:
        transitions = cfg.replay_ratio * num_envs * cfg.learn_every
        fits = [n for n in BATCHES if transitions % n == 0 and n % devices == 0]
        return min(fits, key=lambda n: abs(math.log(n / BATCH)), default=BATCH)
    if cfg.batch_size % devices:
        raise ConfigError(f"batch_size={cfg.batch_size} does not split over {devices} devices")
    return cfg.batch_size


def steps_of_round(cfg: RoundConfig, num_envs: int, batch: int) -> int:
    """The gradient steps of a round.

    Raises:
        ConfigError: `replay_ratio` asks for no whole number of them.
    """
    transitions = whole(cfg.replay_ratio * num_envs * cfg.learn_every)
    if transitions % batch:
        raise ConfigError(
            f"replay_ratio={cfg.replay_ratio}: {cfg.replay_ratio} x num_envs={num_envs} x "
            f"learn_every={cfg.learn_every} transitions are no whole number of batches of "
            f"{batch}; the nearest that fit are {' or '.join(fitting(cfg, num_envs, batch))}"
        )
    return int(transitions // batch)  # a ratio may be a fraction


def whole(x: float) -> float:
    """`x` without its error of rounding, if it is a whole number but for that."""
    return round(x) if math.isclose(x, round(x), rel_tol=1e-12) else x


def fitting(cfg: RoundConfig, num_envs: int, batch: int) -> list[str]:
    """The nearest value of each setting that makes whole gradient steps, where there is one."""
    steps, replayed = num_envs * cfg.learn_every, num_envs * cfg.replay_ratio
    least = batch // math.gcd(batch, steps)  # ratios that fit are multiples of it
    ratio = least * max(1, round(cfg.replay_ratio / least))
    transitions = round(cfg.replay_ratio * steps)
    size = closest(divisors(transitions)[::-1], batch)  # of two as near, the larger one
    every = [n for n in divisors(cfg.horizon) if whole(replayed * n) % batch == 0]
    found = [f"replay_ratio={ratio}", f"batch_size={size}"]
    if every:
        found.append(f"learn_every={closest(every, cfg.learn_every)}")
    return found


def closest(numbers: list[int], to: int) -> int:
    return min(numbers, key=lambda n: abs(n - to))


def divisors(n: int) -> list[int]:
    small = [d for d in range(1, math.isqrt(n) + 1) if n % d == 0]
    return sorted({*small, *(n // d for d in small)})
