"""Measure a peer: python jaxsafe/commands/peers.py crax --num-envs 2048, one JSON line a measurement

Run by the Python in which the peer is installed (peers pin other versions of MuJoCo than jaxsafe), or
by `jaxsafe benchmark --peer crax=PYTHON`. It imports nothing of jaxsafe. Each peer runs its nearest
task:

    crax              safe_goal_point, level 1 (4 substeps, no vase): steps, and its PPO-Lagrangian
    crax-sac-lag      safe_goal_point, level 1: its SAC-Lagrangian
    brax-sac          Brax's halfcheetah, backend generalized: its SAC
    safety-gymnasium  SafetyPointGoal1-v0 in one process a core: steps of random actions
    omnisafe          PPOLag on SafetyPointGoal1-v0, one environment a core: training steps

The two of SAC have the environments, batches and gradient steps that they are given. `jaxsafe
benchmark` gives them those of its --algo, and scripts/brax_sac.py has Brax's task for it:

    jaxsafe benchmark point_goal1 --algo sac_lag --peer crax-sac-lag=PYTHON
    jaxsafe benchmark scripts.brax_sac:task halfcheetah_velocity --algo sac --peer brax-sac

Normalised observations, two hidden layers of 256 units, the replay and its first steps are as ours too.
Everything else is the peer's default. Its evaluations are left out. The others have their own sizes.
"""
# pyright: reportMissingImports=false

import argparse
import functools
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any, NamedTuple

Row = dict[str, Any]


class Sizes(NamedTuple):
    """What a peer may be told: environments, and of SAC the batch and the gradient steps that follow
    one step of all environments."""

    num_envs: int = 2048
    batch_size: int = 4096
    gradient_steps: int = 8


# Of our SAC, by the names that SAC has in Brax, of whose trainer CRAX's is a copy. Its networks have
# two hidden layers of 256 units by default.
SAC: dict[str, Any] = {
    "discounting": 0.99,
    "normalize_observations": True,
    "min_replay_size": 10_000,
    "max_replay_size": 1_000_000,
}
EPOCH = 100  # steps of each environment in a measured epoch of theirs
EPOCHS = 7  # of which the first compiles, and the second goes on to settle


def crax(sizes: Sizes) -> Iterator[Row]:
    import jax
    from crax import envs

    num_envs = sizes.num_envs
    env = envs.create("safe_goal_point", level=1, batch_size=num_envs)
    steps = 100

    @jax.jit
    def run(state: Any, key: Any) -> Any:
        def step(state: Any, key: Any) -> Any:
            action = jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0, maxval=1.0)
            return env.step(state, action), None

        return jax.lax.scan(step, state, jax.random.split(key, steps))[0]

    state = jax.jit(env.reset)(jax.random.key(0))  # it splits the key itself
    seconds = []
    for i in range(7):
        start = time.perf_counter()
        state = jax.block_until_ready(run(state, jax.random.key(i)))
        seconds.append(time.perf_counter() - start)
    found = {"env": "safe_goal_point", "algo": None, "num_envs": num_envs}
    yield found | {"env_steps_per_s": num_envs * steps / statistics.median(seconds[2:])}
    yield found | {"algo": "ppo_lag", "env_steps_per_s": statistics.median(crax_training(num_envs))}


def crax_training(num_envs: int) -> list[float]:
    """Steps/s of its PPO-Lagrangian, by its own clock, with the defaults of `crax-train`."""
    mend_jax()
    from crax import envs
    from crax.training.agents.ppo_lag import train

    rates: list[float] = []

    def progress(step: int, metrics: Row) -> None:
        if "training/sps" in metrics:
            rates.append(float(metrics["training/sps"]))

    batch = 1024 * 32 * 8  # steps of an update: minibatch, minibatches, unroll
    train(
        environment=envs.get_environment("safe_goal_point", level=1),
        num_timesteps=40 * batch,
        episode_length=1000,
        num_envs=num_envs,
        unroll_length=8,
        batch_size=1024,
        num_minibatches=32,
        num_updates_per_batch=6,
        learning_rate=5e-4,
        entropy_cost=5e-3,
        discounting=0.99,
        normalize_observations=True,
        safety_bound=25.0,
        lagrangian_coef_rate=10.0,
        num_evals=0,
        num_eval_envs=1,
        training_metrics_steps=2 * batch,
        progress_fn=progress,
    )
    return rates


def crax_sac_lag(sizes: Sizes) -> Iterator[Row]:
    mend_jax()
    from crax import envs
    from crax.training import acting
    from crax.training.agents.sac_lag import train

    env = envs.get_environment("safe_goal_point", level=1)
    found = {"env": "safe_goal_point", "backend": env.backend, "algo": "sac_lag"}
    yield found | sac_training(train, acting.Evaluator, env, sizes)


def brax_sac(sizes: Sizes) -> Iterator[Row]:
    mend_jax()
    from brax import envs
    from brax.training import acting
    from brax.training.agents.sac.train import train

    env = envs.get_environment("halfcheetah", backend="generalized")
    found = {"env": "halfcheetah", "backend": env.backend, "algo": "sac"}
    yield found | sac_training(train, acting.Evaluator, env, sizes)


def mend_jax() -> None:
    """Give JAX back what Brax 0.14.2 and CRAX 0.1.0 call: see `jaxsafe.interop.brax.mend_brax`."""
    import jax
    import jax.numpy as jnp

    def replicated(tree: Any, devices: list[Any]) -> Any:
        return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)

    if "device_put_replicated" not in vars(jax):
        jax.device_put_replicated = replicated  # type: ignore[attr-defined]


def sac_training(train: Callable[..., Any], evaluator: Any, env: Any, sizes: Sizes) -> Row:
    """Settled steps/s of a trainer of SAC that has Brax's arguments, by the clock of its epochs.

    Args:
        evaluator: the class that it evaluates with at the end of an epoch, which is told not to.
    """
    epochs: dict[int, float] = {}  # steps so far -> steps/s

    def progress(step: int, metrics: Row) -> None:
        if "training/walltime" in metrics:  # an epoch's, not one of the logs within
            epochs[step] = float(metrics["training/sps"])

    evaluator.run_evaluation = lambda self, params, training_metrics, **_: training_metrics
    settings = sac_settings(sizes)
    train(environment=env, num_eval_envs=1, progress_fn=progress, **settings)
    rates = list(epochs.values())[2:]
    replayed = settings["batch_size"] * settings["grad_updates_per_step"]
    return {
        **sizes._asdict(),
        "replay_ratio": replayed / settings["num_envs"],
        "env_steps_per_s": statistics.median(rates),
        "fastest": max(rates),
        "slowest": min(rates),
    }


def sac_settings(sizes: Sizes) -> Row:
    """The arguments of their trainer: `EPOCHS` epochs after it has filled its replay."""
    filled = -(-SAC["min_replay_size"] // sizes.num_envs)  # steps of each environment
    return {
        **SAC,
        "num_envs": sizes.num_envs,
        "batch_size": sizes.batch_size,
        "grad_updates_per_step": sizes.gradient_steps,
        "max_devices_per_host": 1,
        "episode_length": 1000,
        "num_timesteps": (filled + EPOCHS * EPOCH) * sizes.num_envs,
        "num_evals": EPOCHS + 1,  # one of them before the first epoch
    }


def step_alone(seconds: float) -> float:
    """Steps/s of one environment in this process."""
    import safety_gymnasium

    env = safety_gymnasium.make("SafetyPointGoal1-v0")
    env.reset(seed=0)
    env.action_space.seed(0)
    start, steps = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
        steps += 1
    return steps / (time.perf_counter() - start)


def safety_gymnasium(sizes: Sizes) -> Iterator[Row]:
    from multiprocessing import get_context

    cores = os.cpu_count() or 1
    with get_context("spawn").Pool(cores) as pool:
        rates = pool.map(step_alone, [10.0] * cores)
    found = {"env": "SafetyPointGoal1-v0", "algo": None, "num_envs": cores}
    yield found | {"env_steps_per_s": sum(rates)}


def omnisafe(sizes: Sizes) -> Iterator[Row]:
    import omnisafe

    cores, steps = os.cpu_count() or 1, 60_000
    training = {"total_steps": steps, "vector_env_nums": cores, "torch_threads": cores}
    agent = omnisafe.Agent(
        "PPOLag",
        "SafetyPointGoal1-v0",
        custom_cfgs={
            "train_cfgs": training,
            "algo_cfgs": {"steps_per_epoch": 20_000},
            "logger_cfgs": {"use_wandb": False, "save_model_freq": 100},
        },
    )
    start = time.perf_counter()
    agent.learn()
    found = {"env": "SafetyPointGoal1-v0", "algo": "PPOLag", "num_envs": cores}
    yield found | {"env_steps_per_s": steps / (time.perf_counter() - start)}


Measure = Callable[[Sizes], Iterator[Row]]
PEERS: dict[str, tuple[str, Measure]] = {  # name -> (distribution, measurement)
    "crax": ("crax-bench", crax),
    "crax-sac-lag": ("crax-bench", crax_sac_lag),
    "brax-sac": ("brax", brax_sac),
    "safety-gymnasium": ("safety-gymnasium", safety_gymnasium),
    "omnisafe": ("omnisafe", omnisafe),
}


def own_versions() -> dict[str, str]:
    """Of the Python that has the peer, in place of those that `jaxsafe benchmark` runs by."""
    found = {"python": platform.python_version()}
    for package in ("jax", "mujoco", "mujoco-mjx"):
        try:
            found[package] = version(package)
        except ImportError:
            continue
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("peer", choices=sorted(PEERS))
    sizes = Sizes()
    parser.add_argument(
        "--num-envs", type=int, default=sizes.num_envs, help="of a peer with batches of them"
    )
    parser.add_argument(
        "--batch-size", type=int, default=sizes.batch_size, help="transitions of a gradient step of SAC"
    )
    parser.add_argument(
        "--gradient-steps",
        type=int,
        default=sizes.gradient_steps,
        help="of SAC, after each step of all environments",
    )
    args = parser.parse_args()
    distribution, measure = PEERS[args.peer]
    try:
        found = version(distribution)
    except ImportError:
        print(f"{args.peer}: pip install {distribution} for {sys.executable}", file=sys.stderr)
        return 2
    about = {"peer": args.peer, distribution: found, **own_versions()}
    show = functools.partial(print, file=sys.__stdout__, flush=True)
    sys.stdout = sys.stderr  # peers talk
    for row in measure(Sizes(args.num_envs, args.batch_size, args.gradient_steps)):
        show(json.dumps(about | row))
    return 0


if __name__ == "__main__":
    sys.exit(main())
