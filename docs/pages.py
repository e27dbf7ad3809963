"""Write a page for each algorithm and each task from the code: python docs/pages.py

Of an algorithm, docs/algorithms/NAME.md: equations, source and departures are its config's docstring;
settings and their origin are the lines of its config; results are those of docs/results. Of a task,
docs/environments/NAME.md: objects, observations and costs are the environment's, how close it is to the
original is the tables of docs/fidelity.md. A test holds the pages to the code.
"""

import dataclasses
import functools
import importlib
import inspect
import math
import re
import sys
import typing
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any

from jaxsafe.algos import ALGOS, Row
from jaxsafe.algos.ambs import AMBSConfig
from jaxsafe.envs import ENVS, CarRacing, make, pendulum
from jaxsafe.envs.racing import car as racing_car
from jaxsafe.envs.racing import picture as racing_picture
from jaxsafe.envs.racing import task as racing
from jaxsafe.envs.racing import track as racing_track
from jaxsafe.envs.safety_gym import suite
from jaxsafe.envs.safety_gym.config import SafetyGymConfig
from jaxsafe.envs.velocity import config as velocity_config
from jaxsafe.envs.velocity import suite as velocities
from jaxsafe.learn.certificate import CertificateConfig
from jaxsafe.learn.model_based import ModelBasedConfig
from jaxsafe.learn.off_policy import OffPolicyConfig
from jaxsafe.learn.offline import OfflineConfig
from jaxsafe.learn.on_policy import OnPolicyConfig
from jaxsafe.learn.world_model import WorldModelConfig
from jaxsafe.report import stats, studies, study_files
from jaxsafe.report import tables as report
from jaxsafe.report.published import read_published
from jaxsafe.report.read import SettingRun, read
from jaxsafe.run import compat, help
from jaxsafe.run.plain import as_text
from jaxsafe.run.settings import acts_by, first_published, preset_for

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
tables = importlib.import_module("tables")
TASKS = {  # what a robot is paid for
    "goal": "Reach the goal (green), again and again: after each success it is elsewhere.",
    "button": "Press the marked button (orange cylinder), again and again: each success draws another.",
    "push": "Push the box (yellow) to the goal (green), again and again.",
    "run": "Run along x, as far as possible.",
    "circle": "Run along a circle of 1.5 m around the origin.",
    "grid": "Go to a goal straight ahead, once, between hazards at given places.",
}
FAMILIES = {  # the pages of docs/theory
    "prices": ("ppo_lag", "trpo_lag", "rcpo", "pdo", "cup", "cppo_pid", "trpo_pid"),
    "trust_region": ("cpo", "pcpo"),
    "penalties": ("ipo", "p3o", "focops"),
    "budgets": ("ppo_saute", "trpo_saute", "ppo_simmer_pid", "trpo_simmer_pid"),
    "actor_critics": tuple(
        f"{name}{more}" for name in ("ddpg", "td3", "sac") for more in ("", "_lag", "_pid")
    ),
    "recorded_data": ("bcq", "bcq_lag", "crr", "ccrr", "coptidice"),
    "planning": ("pets", "cce_pets", "rce_pets", "cap_pets", "loop", "safe_loop"),
    "certificates": ("crabs",),
    "world_models": ("dreamer", "dreamer_lag", "dreamer_pid", "osrp", "osrp_lag", "ambs"),
}
PLANNING = " env.observation=coordinates env.wrap.action_repeat=5 algo.learn_cost=false"
LOOPS = {  # the first that an algorithm's config is one of
    ModelBasedConfig: "planning",
    WorldModelConfig: "world-model",
    OnPolicyConfig: "on-policy",
    OffPolicyConfig: "off-policy",
    OfflineConfig: "offline",
}
STUDIES = ("goal", "button", "push", "omnisafe", "velocity", "off_policy", "td3")  # in docs/results
OTHERS = ("planning", "shielding", "offline", "seditor")  # with limits, lengths or data of their own
ABSENT = object()  # where there is no default
ALGORITHMS = """# Algorithms

Each page has the equations, the sources, every setting with its origin, the departures from the paper,
and what it made in our runs. Which one to take: [choosing](../choosing.md#an-algorithm).

How families work, step by step: [prices](../theory/prices.md),
[trust regions](../theory/trust_region.md), [penalties](../theory/penalties.md),
[budgets in the state](../theory/budgets.md), [values of actions](../theory/actor_critics.md),
[recorded data](../theory/recorded_data.md), [planning](../theory/planning.md),
[certificates](../theory/certificates.md), [world models](../theory/world_models.md).

The on-policy algorithms share these options:

| option | values |
|---|---|
| `algo.estimator` | `gae`, `gae_rtg`, `plain`, `vtrace` |
| `algo.reward_normalize`, `algo.cost_normalize` | whether the learner sees scaled rewards and costs |
| `algo.reward_centre`, `algo.cost_centre` | whether the mean is taken from them, too |
| `algo.entropy_coef`, `algo.entropy_decay` | a bonus for exploring, and whether it falls to 0 |
| `algo.activation`, `algo.init` | `tanh`, `relu`; `orthogonal`, `torch` |
| `algo.std` | `free`: a parameter; `state`: the network computes it |
| `algo.min_std` | a floor of the standard deviation of actions, to which what is learned is added |
| `algo.trunk` | `separate`: a network each; `shared`: common hidden layers; `gru`: with a memory |

With `shared` and `gru` policy and critics have one loss. Both are for the algorithms whose steps are
Adam's, such as `ppo_lag` and `focops`. They go best with `reward_normalize` and, where an algorithm
takes it, `cost_normalize`, and where episodes cannot fail also with the two that take the mean.

## Letters

The pages of model-free algorithms use the same letters, unless one says otherwise. The code has the
same names. An iteration of an on-policy algorithm collects a batch with the policy
pi_old and then improves it. Off-policy algorithms have values of actions, Q_r and Q_c, where
on-policy ones have advantages.

| letter | what it is | setting or metric |
|---|---|---|
| s, a, r, c | observation, action, reward and cost of a step | |
| pi, theta | the policy, and its parameters | |
| w | pi(a \\| s) / pi_old(a \\| s), the ratio of the probabilities of an action | |
| A_r | advantage of reward, scaled to a standard deviation of 1 in a batch | `algo.gae_lambda` |
| A_c | advantage of cost, in units of cost, with a mean of 0 in a batch | `algo.cost_gae_lambda` |
| A | the advantage that the policy's step maximises | |
| E | mean over the batch | |
| Q_r, Q_c | values of an action in reward and in cost, discounted | `train/q`, `train/q_c` |
| J_c | undiscounted cost of an episode, as the learner estimates it | `train/cost_estimate` |
| lam | price on cost: standard deviations of A_r or Q_r that a unit of cost is worth | `train/lam` |
| KL(old \\|\\| new) | divergence of the new policy from pi_old, in nats | `train/kl` |
| delta | the largest KL of a step | `algo.target_kl` |
| eps | how far w may move from 1 before it is clipped | `algo.clip` |
| gamma | discounts of reward and of cost | `algo.discount`, `algo.cost_discount` |
| (x)+ | max(0, x) | |

## All algorithms

| | |
|---|---|
"""
OPTIONS = """# Options of Safety Gym's tasks

Each is `env.OPTION` on the command line, and an argument of `jaxsafe.make`. Names and defaults are
those of Safety Gym's Engine, except where it says *ours*. A task changes some:
`python scripts/train.py env=point_goal1 --help` shows its values. Lengths are in m, angles in rad.

```sh
python scripts/train.py env=point_goal1 env.hazards_num=12 env.hazards_size=0.3 env.lidar_num_bins=32
```

`env.engine`, `env.wrap.action_repeat` and their like are options of
[every environment](../start.md#the-options).

{tables}
"""
ENVIRONMENTS = """# Environments

A name is a robot and a task: `point_goal1`, `car_push2`, `doggo_button1`. Safety Gym's ids, as in
`Safexp-PointGoal1-v0`, work too. Goal, Button and Push are the suite's 27 tasks. Run, Circle and the
grids are the original's tests. [`env.observe_vision=true`](../howto/pixels.md)
adds what a camera on the robot sees. The six [velocity tasks](velocity.md) are
Safety-Gymnasium's: `ant_velocity` is `SafetyAntVelocity-v1`. So are
[`point_circle1`, `point_run0`](../howto/safety_gymnasium.md) and their like. `seditor_point_goal1` and
its like are [SEditor's tasks](../howto/seditor.md). So are `car_racing0` and `car_racing1`, which are
[stand-ins](racing.md) for car racing in Box2D. The four [pendulums](pendulum.md), such as
`pendulum_upright`, are those of CRABS.

Every [option of Safety Gym's Engine](options.md) is `env.OPTION`.
[`env.rules`](../howto/safety_gymnasium.md) takes Safety-Gymnasium's rules where they differ.
`env.observation=coordinates` shows Goal as positions instead of lidars, 29 numbers in `point_goal1`
([what for](../concepts.md#planning-with-a-model)). How close the physics is to the original:
[fidelity](../fidelity.md).

In Python an environment is two pure functions without a batch axis. `jax.vmap(env.step)` steps
thousands.

```python
import jax

from jaxsafe import envs

env = envs.make("point_goal1", hazards_num=12, lidar_num_bins=32)
state = env.reset(jax.random.key(0))
state = jax.jit(env.step)(state, jax.numpy.array([1.0, 0.2]))
print(state.obs.shape, state.reward, state.cost, dict(zip(env.cost_names, state.costs)))
```

The table has the size of each robot's observation. The vase of `goal1` and the pillar of `push1` are
observed and cost nothing, as in the original.

"""
VELOCITY = """# velocity

Run along x as fast as the threshold allows. A robot is paid for its speed and for staying healthy, and
pays for control. A step costs 1 if the robot is faster than the threshold. The tasks are
Safety-Gymnasium's `Safe Velocity`, on Gymnasium's environments of version 4.

```sh
python scripts/train.py env=hopper_velocity algo=ppo_lag
```

{pictures}

[What algorithms earn here](../results/velocity/README.md), beside OmniSafe.

## Sizes

{table}

- The speed of a robot in a plane is that in x, with its sign. So running backwards costs nothing. The
  speed of Ant and Humanoid is the length of the velocity in x and y.
- The ceiling is the return of 1,000 steps at the threshold without control. An agent that never costs
  cannot earn more; with 25 steps of cost it can earn a little more. A return far above it is a bug.
- `SafetyAntVelocity-v0` and its like have older thresholds: `env.thresholds=v0`. There Swimmer's speed
  in y counts, too.
- Actions are in [-1, 1]. Humanoid's controls are 0.4 times them. An action beyond that does no more,
  but is paid for, as in the original.
- The healthy reward is paid on the step that ends an episode, too, as in version 4.

## Options

{options}

Where a robot has another default, it is in the table of sizes. `env.engine` and `env.wrap` are
[those of every task](README.md).

## Fidelity

The models are our own. A test compares their compiled numbers with those of Gymnasium's files, to
1e-12.
Single steps from the same state are Gymnasium's on engine `c`: positions and observations are the same
float32 numbers, bit for bit. Humanoid has another solver. Its qpos agrees to 2.4e-7. On `jax` and
`warp`, float32 inside, qpos agrees to 1e-5 in 99% of steps, and to 1e-6 in half of them.
So it does on an H200: to 2.1e-6 and 1.5e-7, over 200 random steps of each robot (commit 24de6da, by
`compare` of tests/envs/test_velocity.py).

What differs:

| | here | Safety-Gymnasium |
|---|---|---|
| the velocity of Ant and Humanoid | of the state after the step | of the integrator's last stage |
| Humanoid's inertias, velocities and forces | likewise | likewise |
| Humanoid's solver | Newton's | PGS with 50 iterations |
| Humanoid's actions | [-1, 1] | [-0.4, 0.4] |
| a physics error | ends the episode | goes on with NaN |

With random actions Ant's velocity is 0.001 m/s away from that of the last stage in the median, and 0.1
m/s at most. There is no option for the last stage.

Five tasks take Runge and Kutta's fourth order, HalfCheetah Euler's integrator. Engine `jax` takes
longest to compile for Humanoid, of which 128 pairs of geoms can meet.
"""
RACING = """# racing

Drive a lap of a random track. Each new tile of the road pays 1000 / tiles, so that a whole lap pays a
little less than 1000: the tiles under the wheels at the start pay nothing. The tasks are SEditor's
`SafeCarRacing0-v0` and `SafeCarRacing1-v0`. These ids work, too.

They are stand-ins. The original runs on Box2D, whose physics we do not have. Rewards, costs and sizes
are those of the original. The car and the shapes of tracks are ours, so returns and costs of the
original do not carry over.

```sh
python scripts/train.py env=car_racing1 algo=seditor
python scripts/train.py env=car_racing1 env.observe_vision=true algo=seditor preset=racing
python scripts/train.py env=car_racing1 env.observe_vision=true algo=ppo_lag algo.encoder=cnn \\
    algo.trunk=shared algo.num_envs=64
```

![car_racing1 in a film and as a policy sees it](../images/environments/car_racing1.png)

To the left is a frame of a film. To the right is what a policy sees there with
`env.observe_vision=true`. `jaxsafe watch` refuses these tasks: keys do not drive the car.

## Sizes

{table}

- `off_track` costs 1 on the step in which the last wheel leaves the road, and nothing until the car has
  been back. With obstacles leaving the road costs nothing, as in the original.
- `obstacles` costs 1 on the step in which a wheel meets an obstacle. Once all wheels have left it, the
  next touch costs again.
- An episode ends when all tiles are visited. This is a success, and its value from there on is 0.
- Beside the road the tyres hold 60% of what they hold on it.
- Actions are in [-1, 1]: steering, positive to the right; gas and brake, from -1 (none) to 1 (all).

## Observation

| numbers | |
|---:|---|
| 4 | angular velocities of the wheels, rad/s: front left, front right, rear left, rear right |
| 4 | their angles, rad, positive to the left; those of the rear wheels are 0 |
| 3 | speed, m/s; yaw rate, rad/s; share of the tiles that is left |
| 24 | centres of the nearest tile and of the 2nd, 4th, ..., 22nd after it: x and y, m |
| 9 | with obstacles: x, y and half the width, m, of the next three |

Places are in the car's frame, x to the front and y to the left. In the original wheels can also spin
and lock.

With `env.observe_vision=true` the observation is that of the original's agents, a dict: `vector` has
the first 11 numbers, and `vision` is a grey picture, uint8 [96, 96, 1].
[Many algorithms take it](../howto/pixels.md#learn). `seditor` does so with
[its authors' settings](../howto/seditor.md#racing).

## Pictures

{picture}

JAX draws the picture in the program of the step. 64 environments of `car_racing1` make 11,000 steps a
second with a picture of 96 x 96 each, and 60,000 without. This is of two cores of an AMD EPYC, one of
which another program kept busy (JAX 0.10.2). It was measured so:

```python
import time

import jax

from jaxsafe import envs

env = envs.make("car_racing1", observe_vision=True)


def step(state, key):
    action = jax.random.uniform(key, (64, env.action_size), minval=-1.0)
    return jax.vmap(env.step)(state, action), None


run = jax.jit(lambda state, key: jax.lax.scan(step, state, jax.random.split(key, 200)))
state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 64))
state, _ = jax.block_until_ready(run(state, jax.random.key(1)))
start = time.perf_counter()
jax.block_until_ready(run(state, jax.random.key(2)))
print(64 * 200 / (time.perf_counter() - start))
```

## The environment

{about}

## The car

{car}

## The track

{track}

## Options

{options}

`env.wrap` is [that of every environment](README.md).
"""
PENDULUM = """# pendulum

Four tasks in which one unsafe step ends the episode. They are for algorithms that allow no violation at
all, such as [`crabs`](../algorithms/crabs.md). Their ids in the code of CRABS work, too.

```sh
python scripts/train.py env=pendulum_upright algo=crabs video=false
```

## Sizes

{table}

- Episodes always begin at the same state.
- A safe state has a `barrier` of at most 1. `env.barrier(obs)` gives it. It is 0 in the middle of the
  safe set, and grows fast outside of it.
- `pendulum_move` and `pendulum_swing` are one environment: `env.task` and `env.threshold` make them.
  `env.task=upright` pays for standing still. A run on it makes a safe start for the others.
- There are no pictures of these tasks.

## The environments

{about}

### `pendulum_upright`, `pendulum_tilt`

{pendulum}

### `pendulum_move`, `pendulum_swing`

{cart}

## Options of `pendulum_upright` and `pendulum_tilt`

{pendulum_options}

## Options of `pendulum_move` and `pendulum_swing`

{cart_options}

`env.wrap` is [that of every environment](README.md).
"""
COSTS = {
    "hazards": "inside a hazard (blue disc)",
    "vases_contact": "touching a vase (light blue cube)",
    "vases_velocity": "a vase moves, touched or not",
    "pillars": "touching a pillar (blue column)",
    "buttons": "pressing another button than the goal's",
    "gremlins": "touching a gremlin (purple cube, on a circle of its own)",
}


def prose(docstring: str) -> tuple[str, str]:
    """The docstring's first line, and the rest as Markdown: what is indented is code."""
    title, _, text = inspect.cleandoc(docstring).partition("\n")
    blocks = []
    for block in text.strip("\n").split("\n\n"):
        if block.startswith("    "):
            blocks.append(f"```text\n{inspect.cleandoc(block)}\n```")
        else:  # Source and departures begin lines of their own
            blocks.append(re.sub(r"\n(?=Source:|Differs from)", "\n\n", block))
    return title, "\n\n".join(blocks)


def values(kind: Any) -> str:
    """The bounds of a number, wherever it stands in the type; the words of a choice. Of several
    numbers, or kinds of number, those of each."""
    if typing.get_origin(kind) is typing.Literal:
        return ", ".join(f"`{word}`" for word in typing.get_args(kind))
    if typing.get_origin(kind) is Annotated:
        bounds = typing.get_args(kind)[1]
        infinite = f"; `inf`: {bounds.inf}" if bounds.inf else ""
        return f"{bounds.low:.12g} to {bounds.high:.12g}{infinite}"
    inside = dict.fromkeys(filter(None, map(values, typing.get_args(kind))))
    return (" and " if typing.get_origin(kind) is tuple else " or ").join(inside)


def settings(config: type, head: str = "algo", without: Collection[str] = ()) -> str:
    """A row a field: its default, the values it takes, and the comment in the class that defines it."""
    comments = help.comments(config)
    rows = ["| setting | default | values | |", "|---|---|---|---|"]
    hints = typing.get_type_hints(config, include_extras=True)
    for field in dataclasses.fields(config):
        if field.name in without:
            continue
        note = comments[field.name].replace("|", "\\|")
        default = "" if field.default is dataclasses.MISSING else f"`{as_text(field.default)}`"
        rows.append(f"| `{head}.{field.name}` | {default} | {values(hints[field.name])} | {note} |")
    return "\n".join(rows)


def folded_settings(config: type) -> str:
    """The settings that make this algorithm, then, folded, those that it has as all of its loop do."""
    loop, kind = next((loop, kind) for loop, kind in LOOPS.items() if issubclass(config, loop))
    usual = {field.name: field.default for field in dataclasses.fields(loop)}
    fields = {field.name: field.default for field in dataclasses.fields(config)}
    shared = [name for name, default in fields.items() if usual.get(name, ABSENT) == default]
    specific = [name for name in fields if name not in shared]
    folded = f"""<details markdown>
<summary>{len(shared)} settings that all {kind} algorithms share</summary>

{settings(config, without=specific)}

</details>"""
    return "\n\n".join([settings(config, without=shared)] * bool(specific) + [folded])


def published(row: Row) -> str:
    """What may be changed after training, and what `preset=published` and `compat=omnisafe` change."""
    lines = []
    if names := acts_by(row):
        of = ", ".join(f"`algo.{name}`" for name in names)
        lines.append(
            f"A trained policy acts by {of}. It is [evaluated and filmed](../howto/evaluate.md"
            "#with-other-plans-or-another-shield) with other values of these, too."
        )
    for origin, options in row.published.items():
        changed = ", ".join(f"`{name}={value}`" for name, value in options.items())
        preset = (
            f"`preset=published` ({origin})" if origin == first_published(row) else f"`preset={origin}`"
        )
        lines.append(f"{preset}: {changed}.")
    if suits := suited(row):
        tasks = "; ".join(f"`{name}` on {', '.join(tasks)}" for name, tasks in suits.items())
        lines.append(f"A run that names no preset has {tasks}. On all others it has `fast`.")
    if conventions := compat.overrides("omnisafe", row.config):
        changed = ", ".join(f"`{name}={value}`" for name, value in conventions.items())
        lines.append(f"`compat=omnisafe` ([why](../howto/migrate.md#conventions)): {changed}.")
    return "\n\n".join(lines)


def suited(row: Row) -> dict[str, list[str]]:
    """The tasks on which `preset=auto` is another preset than fast, by that preset."""
    found: dict[str, list[str]] = {}
    for task in ENVS:
        if (preset := preset_for(task, row)) != "fast":
            found.setdefault(preset, []).append(f"`{task}`")
    return found


@functools.cache
def trained() -> list[SettingRun]:
    """The runs of the tables of results that are done, by task and then by whose settings they have."""

    def place(run: SettingRun) -> tuple[str, str]:
        preset, compat = run.config["preset"], run.config["compat"]
        return run.env, compat if compat != "none" else preset if preset != "fast" else ""

    folders = [HERE / "results" / name for name in STUDIES]
    return sorted((run for run in read(folders) if run.ended), key=place)


@functools.cache
def algos_of(study: str) -> set[str]:
    """The algorithms that a study has runs of."""
    return {row["algo"] for row in study_files.read(HERE / "results" / study).rows}


def measured(name: str) -> str:
    """The runs of this algorithm in docs/results."""
    rows = []
    known = read_published(HERE / "results" / "published.csv")
    for run in trained():
        if run.config["algo.name"] != name:
            continue
        ret, cost = (report.cell(stats.of_measure(k, run.values[k]), ".2f") for k in ("return", "cost"))
        rules, compat = run.config.get("env.rules", "safety_gym"), run.config["compat"]
        how = f"`{run.env}`, preset {run.config['preset']}, {len(run.seeds)} seeds"
        how += f", `compat={compat}`" if compat != "none" else ""
        how += f", `env.rules={rules}`" if rules != "safety_gym" else ""
        how += f", {steps:,} steps" if (steps := int(run.config["total_steps"])) != 10_000_000 else ""
        unusual = {k: v for k, v in studies.unusual(run.config).items() if k.startswith("algo.")}
        how += "".join(f", `{k}={v}`" for k, v in unusual.items())
        rows.append(f"| {how} | {ret} | {cost} | {studies.published_cell(run, known)} |")
    found = [study for study in OTHERS if name in algos_of(study)]
    if not rows and found:
        return f"[Its runs](../results/{found[0]}/README.md)."
    if not rows and issubclass(ALGOS[name].config, OfflineConfig):
        return "Not run at length yet."
    if issubclass(ALGOS[name].config, CertificateConfig):
        return "[Short runs](../theory/certificates.md#short-runs). There is no published table."
    if not rows and issubclass(ALGOS[name].config, AMBSConfig):
        return "Not run at length yet; it keeps away from the ledge of tests/toys.py, Ledge."
    if not rows:
        return "Not run at length yet; it learns the small exact problem of tests/toys.py, Lever."
    head = [
        "| limit 25, 1e7 steps a seed if not said | return, last 10% | cost | published |",
        "|---|---|---|---|",
    ]
    return "\n".join([*head, *rows])


def derivation(name: str) -> str:
    """A link to the page that derives the algorithm's family."""
    found = next((page for page, names in FAMILIES.items() if name in names), None)
    return f" The derivation: [{found.replace('_', ' ')}](../theory/{found}.md)." if found else ""


def page(name: str) -> str:
    row = ALGOS[name]
    title, text = prose(row.config.__doc__ or "")
    module = row.config.__module__.rsplit(".", 1)[1]
    more = " dataset=data.npz" if issubclass(row.config, OfflineConfig) else ""
    more += PLANNING if issubclass(row.config, ModelBasedConfig) else ""
    task = "pendulum_upright" if issubclass(row.config, CertificateConfig) else "point_goal1"
    return f"""# {title.removesuffix(".")}

```sh
python scripts/train.py env={task} algo={name}{more}
```

{text}

The letters: [what they mean on all pages](README.md#letters). The code:
[algos/{module}.py](../../algos/{module}.py).{derivation(name)}

## Results

{measured(name)}

## Settings

{folded_settings(row.config)}

{published(row)}
""".replace("\n\n\n", "\n\n")


def fidelity(name: str) -> list[str]:
    """The row of docs/fidelity.md on an environment for each engine: of its first table."""
    rows: dict[str, str] = {}
    engine = ""
    for line in (HERE / "fidelity.md").read_text().splitlines():
        if line.startswith("## "):
            engine = line[3:].removeprefix("Engine ")
        elif line.startswith(f"| {name} |") and engine.startswith("`") and engine not in rows:
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            rows[engine] = f"| {' | '.join([f'`{name}`', engine, *cells[1:5], cells[8], cells[9]])} |"
    return [*rows.values()]


def objects(env: Any) -> str:
    cfg = env.config
    rows = ["| | number | size, m | free around it, m | costs |", "|---|---:|---:|---:|---|"]
    for kind in dict.fromkeys(env.place.kinds):
        size = getattr(cfg, f"{kind}_size", None)
        number, keepout = env.place.kinds.count(kind), getattr(cfg, f"{kind}_keepout")
        paid = any(name.startswith(kind) for name in env.cost_names)
        cells = [kind, number, "" if size is None else size, keepout, "yes" if paid else "no"]
        rows.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(rows)


def observed(env: Any) -> dict[str, int]:
    """Sizes of the components; those of a robot's joints and feet together."""
    found: dict[str, int] = {}
    for name, shape in env.observation_spec.items():
        kind = name.partition("_")[0]
        name = f"{kind}_*" if kind in ("jointpos", "jointvel", "touch") else name
        found[name] = found.get(name, 0) + math.prod(shape)
    return found


def task_page(task: str) -> str:
    made = tables.robots(task)
    kind = next(kind for kind in TASKS if task.startswith(kind))
    env = made[f"point_{task}"]
    parts = [observed(other) for other in made.values()]

    def row(head: str, cells: list[Any]) -> str:
        return f"| {head} | " + " | ".join(map(str, cells)) + " |"

    head = row("", [f"`{name}`" for name in made]) + "\n|---|" + "---:|" * len(made)
    sizes = [row("action", [e.action_size for e in made.values()])]
    sizes += [row("observation", [e.obs_size for e in made.values()])]
    for part in sorted({name for found in parts for name in found}):
        sizes.append(row(part, [found.get(part, "") for found in parts]))
    sizes.append(row("seconds of a step", [f"{e.step_seconds:g}" for e in made.values()]))
    drawn = (HERE / "images" / "environments" / f"point_{task}.jpg").exists()
    images = [f"![{name}](../images/environments/{name}.jpg)" for name in made]
    names = [f"`{name}`" for name in made]
    pictures = "\n".join(
        ["| " + " | ".join(names) + " |", "|---|---|---|", "| " + " | ".join(images) + " |"]
    )
    costs = "\n".join(f"| `{name}` | {COSTS[name]} |" for name in env.cost_names)
    if costs:
        costs = f"A step costs 1 if any of these is so:\n\n| | |\n|---|---|\n{costs}"
    found = [line for name in made for line in fidelity(name)]
    report = "It is not among the recordings of the original."
    if found:
        columns = "| | engine | steps | strict | pose | velocity | events that differ | result |"
        report = "\n".join([columns, "|---|---|---:|---:|---:|---:|---:|---|", *found])
        report += "\n\nWhat the columns mean: [fidelity](../fidelity.md)."
    xmin, ymin, xmax, ymax = env.config.placements_extents
    area = f"x {xmin:g} to {xmax:g} and y {ymin:g} to {ymax:g} m"
    return f"""# {task}

{TASKS[kind]}

```sh
python scripts/train.py env=point_{task} algo=ppo_lag
```

{pictures if drawn else ""}

## Objects

{objects(env)}

They lie in {area}, unless options place them. Sizes are radii, and half sides
of boxes, vases and gremlins; those of Point's task. An episode has {env.episode_length:,} steps.

## Sizes

{head}
{chr(10).join(sizes)}

## Costs

{costs or "None."}

## Fidelity

{report}
""".replace("\n\n\n", "\n\n")


def options_page() -> str:
    """Safety Gym's options under the headings that divide them in the code."""
    config = SafetyGymConfig
    names = [field.name for field in dataclasses.fields(config)]
    parts: dict[str, list[str]] = {"rules": []}
    for line in inspect.getsource(config).splitlines():
        if found := re.match(r"    # ---- (.+)", line):
            parts[found[1]] = []
        elif (found := re.match(r"    (\w+): ", line)) and found[1] in names:
            parts[[*parts][-1]].append(found[1])
    found = []
    for title, those in parts.items():
        rows = settings(config, "env", without={*names} - {*those})
        found.append(f"## {title.capitalize()}\n\n{rows}")
    return OPTIONS.format(tables="\n\n".join(found))


def velocity_page() -> str:
    made = {name: make(name, engine="c") for name in velocities.suite()}
    names = [f"`{name}`" for name in made]

    def row(head: str, cells: list[Any]) -> str:
        return f"| {head} | " + " | ".join(map(str, cells)) + " |"

    def of(attribute: str) -> list[Any]:
        return [getattr(env, attribute) for env in made.values()]

    def option(field: str) -> list[Any]:
        found = [getattr(env.config, field) for env in made.values()]
        return [
            f"{x[0]:g} to {x[1]:g}" if isinstance(x, tuple) else "" if x is None else x for x in found
        ]

    rows = [row("", names), "|---|" + "---:|" * len(made)]
    rows += [row("action", of("action_size")), row("observation", of("obs_size"))]
    parts = dict.fromkeys(part for spec in of("observation_spec") for part in spec)
    for part in parts:
        rows.append(row(part, [spec.get(part, ("",))[0] for spec in of("observation_spec")]))
    rows.append(row("seconds of a step", [f"{x:g}" for x in of("step_seconds")]))
    rows.append(row("threshold, m/s", of("threshold")))
    rows.append(row("threshold of v0", [env.robot.thresholds["v0"] for env in made.values()]))
    rows.append(row("ceiling", [f"{x:,.0f}" for x in of("ceiling")]))
    for field in (
        "frame_skip",
        "forward_reward_weight",
        "ctrl_cost_weight",
        "healthy_reward",
        "healthy_z_range",
        "healthy_angle_range",
        "healthy_state_range",
        "reset_noise_scale",
    ):
        rows.append(row(f"`{field}`", option(field)))
    images = [f"![{name}](../images/environments/{name}.jpg)" for name in made]
    pictures: list[str] = []
    for k in (0, 3):
        pictures += [f"| {' | '.join(names[k : k + 3])} |", "|---|---|---|"]
        pictures += [f"| {' | '.join(images[k : k + 3])} |", ""]
    return VELOCITY.format(
        pictures="\n".join(pictures).strip(),
        table="\n".join(rows),
        options=settings(velocity_config.VelocityConfig, "env"),
    )


def racing_page() -> str:
    made = {name: make(name) for name in racing.ROWS}
    rows = ["| | " + " | ".join(f"`{name}`" for name in made) + " |", "|---|" + "---:|" * len(made)]
    for head, cells in {
        "action": [str(env.action_size) for env in made.values()],
        "observation": [str(env.obs_size) for env in made.values()],
        "tiles for each obstacle": [str(env.obstacle_every or "") for env in made.values()],
        "costs": [", ".join(f"`{name}`" for name in env.cost_names) for env in made.values()],
        "seconds of a step": [f"{racing_car.DT:g}"] * len(made),
    }.items():
        rows.append(f"| {head} | {' | '.join(cells)} |")
    return RACING.format(
        table="\n".join(rows),
        about=prose(racing.__doc__ or "")[1],
        car=prose(racing_car.__doc__ or "")[1],
        picture=prose(racing_picture.__doc__ or "")[1],
        track=prose(racing_track.__doc__ or "")[1],
        options=settings(CarRacing, "env"),
    )


def pendulum_page() -> str:
    made = {name: make(name) for name in pendulum.ROWS}
    ids = {ours: theirs for theirs, ours in pendulum.ALIASES.items()}
    pays = ["-angle^2", "-(angle + 0.41)^2", "place^2", "angle^2"]
    rows = ["| | " + " | ".join(f"`{name}`" for name in made) + " |", "|---|" + "---|" * len(made)]
    for head, cells in {
        "id": [f"`{ids[name]}`" for name in made],
        "reward": pays,
        "unsafe": [f"angle beyond {env.threshold} rad" for env in made.values()],
        "or": ["", "", *[f"cart beyond {pendulum.RAIL} m"] * 2],
        "observation": [str(env.obs_size) for env in made.values()],
        "steps of an episode": [str(env.episode_length) for env in made.values()],
    }.items():
        rows.append(f"| {head} | {' | '.join(cells)} |")
    kinds = pendulum.Pendulum, pendulum.CartPendulum
    return PENDULUM.format(
        table="\n".join(rows),
        about=prose(pendulum.__doc__ or "")[1],
        pendulum="\n\n".join(prose(kinds[0].__doc__ or "")),
        cart="\n\n".join(prose(kinds[1].__doc__ or "")),
        pendulum_options=settings(kinds[0], "env"),
        cart_options=settings(kinds[1], "env"),
    )


def algorithms() -> str:
    """The index of the algorithms' pages."""
    lines = [f"| [`{name}`]({name}.md) | {row.summary} |" for name, row in ALGOS.items()]
    return ALGORITHMS + "\n".join(lines) + "\n"


def pages() -> dict[Path, str]:
    """Every page that is made, by its path."""
    found = {HERE / "algorithms" / f"{name}.md": page(name) for name in ALGOS}
    found[HERE / "algorithms" / "README.md"] = algorithms()
    tasks = list(dict.fromkeys(name.split("_")[1] for name in suite.suite()))
    found |= {HERE / "environments" / f"{task}.md": task_page(task) for task in tasks}
    lines = ["| task | | point | car | doggo | costs |", "|---|---|---:|---:|---:|---|"]
    for task in tasks:
        about = TASKS[next(kind for kind in TASKS if task.startswith(kind))]
        made = list(tables.robots(task).values())
        cells = [f"[`{task}`]({task}.md)", about, *(str(env.obs_size) for env in made)]
        lines.append(f"| {' | '.join(cells)} | {', '.join(made[0].cost_names) or 'none'} |")
    text = ENVIRONMENTS + "\n".join(lines) + "\n"
    found[HERE / "environments" / "options.md"] = options_page()
    found[HERE / "environments" / "velocity.md"] = velocity_page()
    found[HERE / "environments" / "racing.md"] = racing_page()
    found[HERE / "environments" / "pendulum.md"] = pendulum_page()
    return found | {HERE / "environments" / "README.md": text}


if __name__ == "__main__":
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
