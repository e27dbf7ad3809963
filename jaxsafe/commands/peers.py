"""Measure a peer: python jaxsafe/commands/peers.py crax --num-envs 2048, one JSON line a measurement

Run by the Python in which the peer is installed (peers pin other versions of MuJoCo than jaxsafe), or
by `jaxsafe benchmark --peer crax=PYTHON`. It imports nothing of jaxsafe. Each peer runs its nearest
task with its own defaults:

    crax              safe_goal_point, level 1 (4 substeps, no vase): steps, and its PPO-Lagrangian
    safety-gymnasium  SafetyPointGoal1-v0 in one process a core: steps of random actions
    omnisafe          PPOLag on SafetyPointGoal1-v0, one environment a core: training steps
"""
# pyright: reportMissingImports=false

import argparse
import functools
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any

Row = dict[str, Any]


def crax(num_envs: int) -> Iterator[Row]:
    import jax
    from crax import envs

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


def safety_gymnasium(num_envs: int) -> Iterator[Row]:
    from multiprocessing import get_context

    cores = os.cpu_count() or 1
    with get_context("spawn").Pool(cores) as pool:
        rates = pool.map(step_alone, [10.0] * cores)
    found = {"env": "SafetyPointGoal1-v0", "algo": None, "num_envs": cores}
    yield found | {"env_steps_per_s": sum(rates)}


def omnisafe(num_envs: int) -> Iterator[Row]:
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


PEERS: dict[str, tuple[str, Callable[[int], Iterator[Row]]]] = {  # name -> (distribution, measurement)
    "crax": ("crax-bench", crax),
    "safety-gymnasium": ("safety-gymnasium", safety_gymnasium),
    "omnisafe": ("omnisafe", omnisafe),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("peer", choices=sorted(PEERS))
    parser.add_argument("--num-envs", type=int, default=2048, help="of a peer with batches of them")
    args = parser.parse_args()
    distribution, measure = PEERS[args.peer]
    try:
        found = version(distribution)
    except ImportError:
        print(f"{args.peer}: pip install {distribution} for {sys.executable}", file=sys.stderr)
        return 2
    show = functools.partial(print, file=sys.__stdout__, flush=True)
    sys.stdout = sys.stderr  # peers talk
    for row in measure(args.num_envs):
        show(json.dumps({"peer": args.peer, distribution: found} | row))
    return 0


if __name__ == "__main__":
    sys.exit(main())
