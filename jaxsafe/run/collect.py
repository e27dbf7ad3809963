"""Data sets from trained policies: whole episodes of several runs of the same task, in one file."""

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxsafe
from jaxsafe.config import Bounds, ConfigError, one_line
from jaxsafe.learn.acting import Player, Step, played
from jaxsafe.learn.constraints import cost_title, limits_of
from jaxsafe.learn.observations import observation_like, vector_of, with_vector
from jaxsafe.learn.offline import DataSet, data_set
from jaxsafe.run import checkpoint, dataset, files, run_folder
from jaxsafe.run.policies import RunPolicies, check_same_task
from jaxsafe.types import PyTree, State

AT_ONCE = 1000  # episodes that one call of the compiled program plays, at most
AT_ONCE_BYTES = 10**9  # of what is observed in them
Size = Annotated[int, Bounds(1, 10**9)]  # transitions


class Ingredient(NamedTuple):
    """A run, and its share of the transitions."""

    run: RunPolicies
    share: float


class Steps(NamedTuple):
    """T steps of an episode, as they are recorded; `obs` is [T + 1, ...]."""

    obs: PyTree
    action: jax.Array
    reward: jax.Array
    cost: jax.Array
    costs: jax.Array
    terminated: jax.Array
    alive: jax.Array  # bool [T], the step is part of the episode


def shares(texts: Sequence[str]) -> list[tuple[Path, float]]:
    """'RUN:SHARE', or 'RUN' for what the others leave, as folders and shares that sum to 1.

    Raises:
        ConfigError: shares that are no numbers in (0, 1], or do not sum to 1.
    """
    found: list[tuple[Path, float | None]] = []
    for text in texts:
        folder, colon, share = text.rpartition(":")
        folder, share = (folder, share) if colon else (text, "")
        try:
            number = float(share) if colon else None
        except ValueError:
            number = math.nan
        if number is not None and not 0 < number <= 1:
            raise ConfigError(f"{text}: expected RUN:SHARE, with a share between 0 and 1")
        found.append((Path(folder).expanduser(), number))
    given = sum(share for _, share in found if share is not None)
    rest = sum(share is None for _, share in found)
    if rest > 1 or (rest and given >= 1) or (not rest and abs(given - 1) > 1e-6):
        raise ConfigError(f"the shares sum to {given:g}; expected 1, or one run without a share")
    return [(folder, 1 - given if share is None else share) for folder, share in found]


def check_shares(given: Sequence[float]) -> None:
    """Raise ConfigError unless these are shares of one whole."""
    if not all(0 < share <= 1 for share in given) or abs(sum(given) - 1) > 1e-6:
        raise ConfigError(
            f"shares {', '.join(f'{x:g}' for x in given)}: expected numbers that sum to 1"
        )


def data_file(path: str | Path) -> Path:
    """The path, of a file that can be written.

    Raises:
        ConfigError: another kind of file, a folder, or a place where nothing can be written.
    """
    out = Path(path).expanduser()
    if out.suffix not in (".hdf5", ".npz"):
        raise ConfigError(f"out={out}: expected a name that ends in .hdf5 or .npz")
    if out.is_dir():
        raise ConfigError(
            f"out={out} is a folder; expected a file, such as {out / f'data{out.suffix}'}"
        )
    above = files.nearest_above(out.parent)
    if not above.is_dir():
        raise ConfigError(f"out={out}: {above} is {files.kind_of(above)}; expected a folder")
    try:
        files.try_writing(above)
    except OSError as error:
        raise ConfigError(f"out={out}: cannot write to {above}: {error.strerror}") from error
    return out


def episode(player: Player, key: jax.Array, obs_size: int, sampled: bool) -> Steps:
    """One episode, pure, of `episode_length` steps; those after its end are not `alive`.

    What an augmentation appends to the observation is left out. Actions are clipped to [-1, 1], as
    environments clip them.
    """

    def observed(state: State) -> PyTree:
        return with_vector(state.obs, vector_of(state.obs)[:obs_size])

    def seen(step: Step) -> Steps:
        return Steps(
            obs=observed(step.after),
            action=jnp.clip(step.action, -1.0, 1.0),
            reward=step.after.reward,
            cost=step.after.cost,
            costs=step.after.costs,
            terminated=step.after.terminated,
            alive=step.now.alive,
        )

    start, steps = played(player, key, seen, sampled)
    obs = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), observed(start), steps.obs)
    return steps._replace(obs=obs)


def episodes(run: RunPolicies, steps: int, seed: int, sampled: bool) -> Iterator[tuple[int, Steps]]:
    """Episodes without end, the policies of the run in turn: (index of the policy, steps).

    They come from one compiled program, which plays some of each policy at once: as many as `steps`
    fill if none ends early, within `AT_ONCE`.
    """
    policies = len(jax.tree.leaves(run.learned)[0])
    wanted = math.ceil(steps / run.env.episode_length)
    seen = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(observation_like(run.env)))
    fit = max(1, AT_ONCE_BYTES // (seen * run.env.episode_length))
    each = math.ceil(min(AT_ONCE, fit, wanted) / policies)

    def of_one(learned: PyTree, keys: jax.Array) -> Steps:
        player = Player(run.algo.policy, learned, run.algo.task(learned))
        return jax.vmap(lambda key: episode(player, key, run.env.obs_size, sampled))(keys)

    play = jax.jit(jax.vmap(of_one))
    key, turn = jax.random.fold_in(jax.random.key(seed), 0x636F6C6C), 0
    while True:
        keys = jax.random.split(jax.random.fold_in(key, turn), (policies, each))
        played: Any = jax.tree.map(np.asarray, play(run.learned, keys))
        for i in range(each):
            for policy in range(policies):
                yield policy, jax.tree.map(lambda x, p=policy, i=i: x[p, i], played)
        turn += 1


class Collected(NamedTuple):
    """A data set, which run and policy each transition is from, int32 [n], and the recipe."""

    data: DataSet
    run: np.ndarray
    policy: np.ndarray
    recipe: dict[str, Any]


def collect(
    ingredients: Sequence[Ingredient], size: int, seed: int = 0, sampled: bool = True
) -> Collected:
    """At least `size` transitions in whole episodes, each run's share of them.

    A run gives episodes until it has its share; the one that passes it is the last. An episode that
    holds a number that is not finite is left out.

    Raises:
        ConfigError: runs of different tasks, or a run whose every episode has such numbers.
    """
    check_same_task([x.run.folder for x in ingredients], [x.run.settings for x in ingredients])
    parts: list[dict[str, Any]] = []
    recipe = []
    for number, (run, share) in enumerate(ingredients):
        wanted, have, kept, lost = math.ceil(share * size - 1e-6), 0, 0, 0
        source = episodes(run, wanted, seed + number, sampled)
        while have < wanted:
            policy, steps = next(source)
            made = arrays(steps)
            if not all(np.isfinite(x).all() for x in jax.tree.leaves(made)):
                lost += 1
                if lost > max(10, 10 * kept):
                    raise ConfigError(f"{run.folder} plays episodes with numbers that are not finite")
                continue
            count = len(made["reward"])
            have, kept = have + count, kept + 1
            parts.append(
                made
                | {"run": np.full(count, number, np.int32), "policy": np.full(count, policy, np.int32)}
            )
        recipe.append(about(run) | {"share": share, "episodes": kept, "transitions": have})
    whole: dict[str, Any] = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    run, policy, costs = (whole.pop(name) for name in ("run", "policy", "costs"))
    names = ingredients[0].run.env.cost_names
    data = data_set(**whole, costs={name: costs[:, k] for k, name in enumerate(names)})
    return Collected(data, run, policy, {"runs": recipe, "seed": seed, "size": size})


def write(
    out: Path, ingredients: Sequence[Ingredient], size: int, seed: int = 0, sampled: bool = True
) -> Collected:
    """As `collect`, and the file `out` of it, with what it was made of.

    Raises:
        checkpoint.NotSaved: the file could not be written, as on a full disk.
    """
    made = collect(ingredients, size, seed, sampled)
    env = ingredients[0].run.settings.plain()["env"]
    more = {"run": made.run, "policy": made.policy, "episode": made.data.episodes.number}
    data = jax.tree.map(np.asarray, made.data)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        dataset.write_dataset(out, data, more, attributes(made, env, sampled))
    except OSError as error:
        reason = error.strerror or one_line(error)
        raise checkpoint.NotSaved(f"cannot write {out}: {reason}; no data set is written") from error
    return made


def arrays(steps: Steps) -> dict[str, Any]:
    """The steps that are part of the episode; the last one ends it."""
    count = int(np.asarray(steps.alive).sum())
    terminated = np.asarray(steps.terminated)[:count]
    last = np.arange(count) == count - 1
    return {
        "obs": jax.tree.map(lambda x: x[:count], steps.obs),
        "next_obs": jax.tree.map(lambda x: x[1 : count + 1], steps.obs),
        "action": steps.action[:count],
        "reward": steps.reward[:count],
        "cost": steps.cost[:count],
        "costs": steps.costs[:count],
        "terminated": terminated,
        "truncated": last & ~terminated,
    }


def about(run: RunPolicies) -> dict[str, Any]:
    settings = run.settings
    return {
        "run": run.folder.name,
        "algo": settings.algo_name,
        # in force, of each setting
        "limits": [
            {cost_title(name): most for name, most in limits_of(cfg).items()}
            for cfg in settings.configs
        ],
        "seeds": settings.train.num_seeds,
        "first_seed": settings.train.seed,
        "trained_by": run_folder.trained_by(run.folder),
    }


def attributes(collected: Collected, env: dict[str, Any], sampled: bool) -> dict[str, str]:
    """What the file says of itself."""
    return {
        "recipe": json.dumps(collected.recipe),
        "env": json.dumps(env),
        "actions": "sampled" if sampled else "mean",
        "jaxsafe": jaxsafe.__version__,
        "commit": run_folder.commit() or "",
    }
