"""Compare engines over whole episodes: python scripts/closed_loop.py point_goal2 --variants c c:3 warp

A variant is an engine, or engine:k with k vases and k gremlins awake. All drive the same layouts with
the same policy: steer for the goal (or the box) with the lidar, noise added; Doggo, which no such rule
can walk, takes random actions. The first variant is the reference: beside each mean stands the
difference to it with its 95% interval, from the episodes' differences, layout by layout.
"""

import argparse
import json
import sys
from functools import partial
from pathlib import Path

from jaxsafe.commands.jaxsafe import leaving_at_ctrl_c

with leaving_at_ctrl_c():
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsafe import envs
    from jaxsafe.commands.benchmark import versions
    from jaxsafe.commands.guard import guarded
    from jaxsafe.config import ConfigError
    from jaxsafe.learn.rollout import collect, init_rollout, memoryless
    from jaxsafe.run.flags import Parser

TURN, NOISE = 4.0, 0.3  # action per radian, and its standard deviation


def robot(env: envs.SafetyGym) -> str:
    return Path(env.config.robot_base).stem


def seek(env: envs.SafetyGym, obs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Actions [N, A] towards the brightest part of the goal's lidar, or the box's."""
    sizes = {name: int(np.prod(shape)) for name, shape in env.observation_spec.items()}
    target = "box_lidar" if env.config.task == "push" else "goal_lidar"
    start = sum(sizes[name] for name in list(sizes)[: list(sizes).index(target)])
    lidar = obs[:, start : start + sizes[target]]
    bins = (jnp.arange(sizes[target]) + 0.5) * 2 * jnp.pi / sizes[target]
    car = robot(env) == "car"
    front = -jnp.pi / 2 if car else 0.0  # in the robot's frame, where positive actions drive
    lit = jnp.arctan2(lidar @ jnp.sin(bins), lidar @ jnp.cos(bins)) - front
    angle = jnp.arctan2(jnp.sin(lit), jnp.cos(lit))
    forward, turn = jnp.maximum(0.0, jnp.cos(angle)), jnp.clip(TURN * angle, -1, 1)
    action = [forward + turn / 2, forward - turn / 2] if car else [forward, turn]
    action = jnp.stack(action, 1)
    noise = NOISE * jax.random.normal(key, action.shape)
    return jnp.clip(action + noise, -1, 1), jnp.zeros(len(obs))


def flail(env: envs.SafetyGym, obs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    action = jax.random.uniform(key, (len(obs), env.action_size), minval=-1)
    return action, jnp.zeros(len(obs))


def run(name: str, variant: str, episodes: int) -> dict[str, list[float]]:
    """Sums over each of the episodes: return, cost, every cost's, successes."""
    if episodes < 2:
        raise ConfigError(f"--episodes {episodes}: expected at least 2, for an interval")
    engine, _, awake = variant.partition(":")
    if awake and not awake.isdigit():
        raise ConfigError(f"{variant!r}: expected engine or engine:k, as in c:3")
    options = {"awake": int(awake)} if awake else {}
    env = envs.make(name, engine=engine, **options)
    if not isinstance(env, envs.SafetyGym) or "goal_lidar" not in env.observation_spec:
        raise ConfigError(f"{name}: expected a task of Safety Gym with a lidar for its goal")
    policy = partial(flail if robot(env) == "doggo" else seek, env)
    reset_key, key = jax.random.split(jax.random.key(0))
    rollout = jax.jit(init_rollout, static_argnums=(0, 2, 3))(env, reset_key, episodes, False)
    go = jax.jit(
        lambda rollout, key: collect(env, memoryless(policy), rollout, key, env.episode_length)
    )
    trajectory = jax.device_get(go(rollout, key)[1])
    if not trajectory.ended[-1].all():
        raise ConfigError(f"{name}: episodes ended early, so their sums cannot be compared")
    last = jax.tree.map(lambda x: x[-1], trajectory.episode)
    sums = {"return": last.ret, "cost": last.cost}
    sums |= {f"cost_{c}": last.costs[:, i] for i, c in enumerate(env.cost_names)} | last.info
    return {k: np.asarray(v, float).round(4).tolist() for k, v in sums.items()}


def interval(x: np.ndarray) -> float:
    """Half the width of the 95% interval of the mean."""
    return float(1.96 * x.std(ddof=1) / np.sqrt(len(x)))


def table(rows: list[dict]) -> str:
    """Markdown; a row a task and variant. The first variant of a task is the reference of those after
    it, anew each time that it was run."""
    names = ("return", "cost", "goal_met", "cost_hazards", "cost_vases_contact", "cost_vases_velocity")
    names += ("cost_gremlins", "cost_buttons", "cost_pillars")
    lines = [f"| task | variant | {' | '.join(names)} |", "|---|---|" + "---:|" * len(names)]
    reference: dict[str, dict] = {}
    for row in rows:
        base = reference.setdefault(row["env"], row)
        if row["variant"] == base["variant"]:
            base = reference[row["env"]] = row
        cells = []
        for name in names:
            if name not in row["sums"]:
                cells.append("")
                continue
            x, x0 = np.array(row["sums"][name]), np.array(base["sums"][name])
            shown = f"{x.mean():.2f}"
            if row is base:
                shown += f" ± {interval(x):.2f}"
            else:
                shown += f" ({(x - x0).mean():+.2f} ± {interval(x - x0):.2f})"
            cells.append(shown)
        lines.append(f"| {row['env']} | {row['variant']} | {' | '.join(cells)} |")
    return "\n".join(lines)


def command() -> int:
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("envs", nargs="*", metavar="ENV")
    parser.add_argument("--variants", nargs="+", default=["c", "c:3"], metavar="ENGINE[:K]")
    parser.add_argument("--episodes", type=int, default=128)
    parser.add_argument("--json", type=Path, help="append the rows to this file, and show all it holds")
    args = parser.parse_args()
    rows = []
    if args.json and args.json.exists():
        rows = [json.loads(line) for line in args.json.read_text().splitlines()]
    for name in args.envs:
        for variant in args.variants:
            sums = run(envs.canonical(name), variant, args.episodes)
            rows.append({"env": name, "variant": variant, "sums": sums, **versions()})
            if args.json:
                with args.json.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
            print(f"{name} {variant}: return {np.mean(sums['return']):.2f}", file=sys.stderr)
    print(table(rows))
    return 0


def main() -> int:
    return guarded(command)


if __name__ == "__main__":
    sys.exit(main())
