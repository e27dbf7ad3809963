"""What a notebook or a program of yours imports: train, evaluate, render, sweep and collect.

    run = jaxsafe.train("point_goal1", "ppo_lag", cost_limit=10, num_seeds=4, total_steps=1e6)
    print(jaxsafe.evaluate(run))
    jaxsafe.render(run, "policy.gif")

They are the scripts' own functions, so a run folder is the same whoever trained it. `import jaxsafe`
loads this module when one of its names is first used.
"""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsafe import envs
from jaxsafe.config import ConfigError, EpisodeCount, Index, Seed, convert, flat
from jaxsafe.envs import SafetyGymConfig, VelocityConfig
from jaxsafe.learn.acting import Player, first_actions
from jaxsafe.learn.observations import check_fits, observation_like
from jaxsafe.report import evaluation, film, sweep_summary
from jaxsafe.report.evaluation import Scores
from jaxsafe.report.finish import finish
from jaxsafe.report.group import Group
from jaxsafe.run import collect as collecting
from jaxsafe.run import distributed, files, run_folder, session
from jaxsafe.run import sweep as sweeps
from jaxsafe.run.choice import asked_for, chosen, full_names
from jaxsafe.run.collect import Collected, Ingredient
from jaxsafe.run.devices import use_compilation_cache
from jaxsafe.run.loggers import Callback
from jaxsafe.run.plain import to_plain
from jaxsafe.run.policies import ROBOT, RunPolicies, open_run
from jaxsafe.run.progress import Reporter
from jaxsafe.run.session import Session
from jaxsafe.run.settings import acting, load, nested, settings_from_options, settings_of_run, yours
from jaxsafe.run.sweep_plan import plan
from jaxsafe.types import Env, PyTree


def make(env: str | SafetyGymConfig | VelocityConfig, **options: Any) -> Any:
    """Build an environment: `reset(key)` and `step(state, action)`, pure and without a batch axis.

        env = jaxsafe.make("point_goal1", hazards_num=12)
        state = jax.jit(env.step)(env.reset(jax.random.key(0)), jnp.array([1.0, 0.2]))

    Observations are float [obs_size], actions float [action_size] in [-1, 1]; `state` has the reward
    and the cost of the step and, in `costs`, those of each of `env.cost_names`.

    Args:
        env: a name ('car_push1'), an id ('Safexp-CarPush1-v0'), 'module:name' for code of
            yours, which is imported, or a config of Safety Gym or of a velocity task.
        options: Safety Gym's (`hazards_num`, ...; lengths in m, angles in rad) or a velocity task's
            (`velocity_threshold`, ...), both with `engine`: 'auto', 'c', 'warp' or 'jax'. Of any other
            environment, the arguments of the function that makes it. All have `wrap`.

    Returns:
        The environment; of 'module:name' what stands there, if it is an `Env` (jaxsafe.types).

    Raises:
        ConfigError: an unknown name or option (with the nearest valid one), a value of the wrong type,
            or a task that cannot be built or has no valid layout.

    Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
        Learning", for the tasks and their options.
    """
    if isinstance(env, str):
        load("env", env)
    return envs.make(env, **to_plain(options))


class Run:
    """A finished or stopped run, read from its folder.

        run = jaxsafe.Run("runs/point_goal1-ppo_lag/20260101-120000-seed0")

    Its policies are numbered: every seed of the first setting, then of the next. Nothing in the folder
    is executed.

    Args:
        folder: the run folder.
        env: the environment, where the run was trained with an object of yours or 'module:name'.
        algo: the algorithm, likewise.
        acts_by: other values of settings that a planner or a shield acts by: `delta=0.5`.

    Attributes:
        folder: Path.
        settings: everything the run is made of, checked; `settings.algo.cost_limit`, for one.

    Raises:
        ConfigError: no run folder, one of settings that this version does not have, or a setting by
            which a trained policy does not act.
    """

    def __init__(
        self, folder: str | Path, env: str | Env | None = None, algo: Any = None, **acts_by: Any
    ):
        choice = chosen(env, algo)
        self._extras, self._given = choice.extras, {*flat(nested(choice.given))}
        self.folder, self._acts_by = Path(folder).expanduser(), to_plain(acts_by)
        saved = settings_of_run(run_folder.read_config(self.folder), self._extras)
        self.settings = acting(saved, self._acts_by) if acts_by else saved

    def __repr__(self) -> str:
        s = self.settings
        seeds = f"{s.train.num_seeds} seed{'s' * (s.train.num_seeds > 1)}"
        settings = f"{len(s.configs)} settings, " * (len(s.configs) > 1)
        name = f"{s.env_name}, {s.algo_name}, {settings}{seeds}"
        done = run_folder.newest_progress(self.folder)
        far = f"{done.updates:,} updates" if done and not done.steps else f"{self.steps:,} steps"
        return f"Run({str(self.folder)!r}: {name}, {far})"

    @property
    def config(self) -> dict[str, Any]:
        """config.yaml as plain values: {'env': {...}, 'algo': {...}, 'total_steps': ...}."""
        return self.settings.plain()

    @property
    def steps(self) -> int:
        """Environment steps of each seed up to the newest checkpoint; 0 without one."""
        done = run_folder.newest_progress(self.folder)
        return done.steps if done else 0

    @property
    def metrics(self) -> dict[str, np.ndarray]:
        """metrics.csv: 'iteration', 'steps', 'updates' and 'seconds' are float [T], over iterations.

        The rest are float [T, P], over policies, with NaN where an iteration had no value (no episode
        ended). Environment steps and updates (gradient steps) are of one seed; 'train/return' and
        'train/cost' are undiscounted sums of an episode.
        Empty before the first iteration.
        """
        table = run_folder.read_metrics(self.folder)
        num = self.settings.num_members
        rows = len(table["steps"]) // num if table else 0
        whole = {name: x[: rows * num].reshape(rows, num) for name, x in table.items()}
        common = {*run_folder.INDEX} - {"seed"}
        return {name: x[:, 0] if name in common else x for name, x in whole.items()}

    def policy(self, obs: PyTree, key: jax.Array | None = None, index: int = 0) -> jax.Array:
        """The action of a trained policy, compiled; it may be used inside `jit`, `vmap` and `scan`.

        A policy with a memory acts as at the first step of an episode; for whole episodes see `player`.

        Args:
            obs: float [..., obs_size] of `run.env(index)`, as the environment gives it, or a dict of
                that, 'vector', and pictures, 'vision'.
            key: a random key to sample with, anew for each row of a batch; None is the mean, which
                `evaluate` uses too.
            index: which policy.

        Returns:
            float [..., action_size]; environments clip it to [-1, 1].

        Raises:
            ConfigError: no such policy, no checkpoint yet, an observation of another environment, or a
                policy that plans in the simulator.
        """
        player = self._opened.one(index).player
        if player.policy.privileged(player.learned):
            raise ConfigError(
                f"{self.folder}: this policy plans in the simulator, so an observation is not enough; "
                "player(index) takes a state"
            )
        check_fits(obs, self._observed)
        return self._act(self._opened.learned, index, obs, key)

    def player(self, index: int = 0) -> Player:
        """A trained policy with its memory: `carry = player.begin()`, then at each step
        `action, carry = player.act(carry, state)` with the `state` of `player.task`.

        Args:
            index: which policy.

        Returns:
            The policy, with what it has learned and `task`, the environment that it meets.

        Raises:
            ConfigError: no such policy, or no checkpoint yet.
        """
        return self._opened.one(index).player

    def env(self, index: int = 0) -> Env:
        """The environment as a policy meets it: with what an algorithm adds to the observation, as
        PPO-Saute does its budget.

        Args:
            index: which policy.

        Returns:
            An environment: `reset(key)` and `step(state, action)`, without a batch axis.

        Raises:
            ConfigError: no such policy, or no checkpoint yet.
        """
        return self.player(index).task

    @functools.cached_property
    def _opened(self) -> RunPolicies:
        use_compilation_cache()
        saved = flat(self.settings.plain())
        code = [f"{ROBOT}={saved[ROBOT]}"] if ROBOT in self._given else []
        return open_run(self.folder, code, self._extras, self._acts_by)

    @functools.cached_property
    def _observed(self) -> PyTree:
        return observation_like(self.env())

    @functools.cached_property
    def _act(self) -> Any:
        algo = self._opened.algo

        def act(every: PyTree, index: Any, obs: PyTree, key: jax.Array | None) -> jax.Array:
            return first_actions(algo.policy, jax.tree.map(lambda x: x[index], every), obs, key)

        return jax.jit(act)


class SweepResult(NamedTuple):
    """A trained sweep; printed, it is the table of its settings.

    folder: with the files of the summary, and a run folder for each program.
    rows: one a setting: `row.name`, `row.cost_limit`, `row.ret` and `row.cost` (mean, low, high over
        seeds of the last 10% of training, or of the final evaluation where training plays no
        episodes), `row.returns` and `row.costs`, float [S], and `row.held`, whether every limit is:
        'yes', 'no', 'unclear' within the interval or, of two seeds, by one, 'diverged' if a seed did,
        or '-' if not known.
    runs: the run folders.
    """

    folder: Path
    rows: list[Group]
    runs: list[Run]

    def __str__(self) -> str:
        return sweep_summary.markdown(self.rows)


def train(
    env: str | Env | None = None, algo: Any = None, callback: Callback | None = None, **options: Any
) -> Run:
    """Train, then evaluate and film the policy: scripts/train.py as a function.

        jaxsafe.train("point_goal1", "ppo_lag", cost_limit=10, num_seeds=4, total_steps=1e6)
        jaxsafe.train(jaxsafe.make("point_goal1", hazards_num=12), "cpo", run_dir="runs/twelve")

    Ctrl-C, or a notebook's stop button, saves a checkpoint after the iteration under way and then
    raises KeyboardInterrupt; `jaxsafe.train(resume=FOLDER)` goes on from there, and
    `jaxsafe.Run(FOLDER)` reads what there is. A second one leaves at once.

    Args:
        env: a name, default 'point_goal1'; an environment from `make`; or any `Env` of yours
            (jaxsafe.types), which is recorded under the name of its class.
        algo: a name, default 'ppo_lag'; or one of yours: an object with `config`, a class under
            `jaxsafe.config.config`, and `make(env, axis_name=None)`, such as `jaxsafe.algos.Row`,
            which is recorded under the name of that class.
        callback: called as `callback(clock, metrics)` once an iteration is written. `clock` has the
            `iteration`, and the environment `steps` and `updates` of one seed; `metrics` are those of
            metrics.csv, float32 [P] over policies. What it raises ends the training; the last
            checkpoint stays.
        options: settings of the run as on the command line (`total_steps` of each seed, `num_envs`,
            `num_seeds`, `seed`, `devices`, `preset`, `compat`, `run_dir`, `resume`, `init_from`,
            `video`, ...) and of the algorithm, whose prefix may be left out (`cost_limit`:
            undiscounted cost of an episode). An option of the environment is
            `**{"env.hazards_num": 12}`, or an argument of `make`. Values may be NumPy's numbers and
            arrays, tuples and paths.

    Returns:
        The run. One with an object of yours goes on, and opens, with that object alone
        (`train(env, algo, resume=FOLDER)`, `Run(FOLDER, env, algo)`), not from the command line.

    Raises:
        ConfigError: where the script would print a line and end: an unknown name (with the nearest
            valid one), a value of the wrong type or out of bounds, a run that does not fit the memory.
        jaxsafe.run.checkpoint.NotSaved, OSError: the disk failed; the last checkpoint stays.
        jaxsafe.run.divergence.Diverged: the run learns no more; likewise.
        jaxsafe.run.memory.OutOfMemory: the memory was too small in the middle of it; likewise.
        KeyboardInterrupt: stopped, see above.
    """
    for name in distributed.OPTIONS:
        if options.get(name) is not None:
            raise ConfigError(f"{name}: several processes are for the command line")
    choice = chosen(env, algo)
    settings = settings_from_options(nested(choice.given | full_names(choice, options)), choice.extras)
    report = Reporter(hosted=True)
    folder = session.choose_folder(settings, None, report.line)
    made, program = session.prepare(settings)
    choice.say_whose(report)
    needed = {kind: repr(name) for kind, name in yours(settings).items()}
    needed |= {kind: f"<your {name}>" for kind, name in choice.objects.items()}
    words = [f"{k}={v}" if k.isidentifier() else f"**{{{k!r}: {v}}}" for k, v in needed.items()]
    resume_command = f"jaxsafe.train({', '.join([*words, f'resume={str(folder)!r}'])})"
    callbacks = () if callback is None else (callback,)
    asked = Session(settings, folder, made, program, resume_command, callbacks)
    if session.run(asked, report, finish):
        raise KeyboardInterrupt(f"stopped; continue with {resume_command}")
    run = Run(folder, env, algo)
    run._given |= options.keys()
    return run


def sweep(env: Any = None, algo: Any = None, **options: Any) -> SweepResult:
    """Train a grid of settings, scripts/sweep.py as a function: every option that is a list is swept.

        jaxsafe.sweep("point_goal1", "ppo_lag", cost_limit=[5, 10, 25, 50], num_seeds=8)
        jaxsafe.sweep("point_goal1", ["cpo", "ppo_lag"], hidden=[(64, 64), (128, 128)])

    Floats of the algorithm and the `num_seeds` seeds of each setting train side by side, as members of
    one compiled program. Any other option, `seed` among them, is a program for each of its values. The
    same call again goes on where it was stopped.

    Args:
        env: as of `train`, or a list of names.
        algo: as of `train`, or a list.
        options: as of `train`; a list holds the values to sweep, so that a value which is itself a
            list is a tuple; `cost_limits={"hazards": [5, 10], "vases_contact": 25}` sweeps one limit of
            several. `max_parallel` is the number of members trained at once, by default as
            many as the memory holds; `run_dir` the sweep's folder.

    Returns:
        Its table and its runs.

    Raises:
        ConfigError: as of `train`, or nothing to sweep.
        jaxsafe.run.checkpoint.NotSaved, OSError: the disk failed; what was saved stays.
        jaxsafe.run.divergence.Diverged: a run did, after the others were trained.
        KeyboardInterrupt: stopped, with a checkpoint.
    """
    choice = chosen(env, algo)
    asked = plan(*asked_for(choice, options), choice.extras)
    report = Reporter(hosted=True)
    choice.say_whose(report)
    resume_command = "the same call of jaxsafe.sweep"
    summarise = functools.partial(sweep_summary.summarise, extras=choice.extras)
    if sweeps.train(asked, resume_command, report, sweeps.After(finish, summarise)):
        raise KeyboardInterrupt(f"stopped; continue with {resume_command}")
    summarise(asked.folder)
    rows = sweep_summary.rows_of(asked.folder, choice.extras)
    folders = files.runs_in(asked.folder)
    return SweepResult(asked.folder, rows, [Run(folder, env, algo) for folder in folders])


def collect(
    runs: Mapping[Any, float],
    path: str | Path = "data.hdf5",
    size: float = 1_000_000,
    seed: int = 1,
    sampled: bool = True,
) -> Collected:
    """Record whole episodes of trained policies in a data set, scripts/collect.py as a function.

        jaxsafe.collect({ppo: 0.5, ppo_lag: 0.5}, "mixed.hdf5", size=2e5)
        jaxsafe.train("point_goal1", "bcq_lag", dataset="mixed.hdf5")

    Args:
        runs: a share of the transitions for each run, or for its folder. All are of the same task.
        path: the file to write, .hdf5 or .npz.
        size: transitions in all, rounded up to whole episodes.
        seed: of the episodes.
        sampled: whether actions are sampled, or the mean ones.

    Returns:
        What is in the file: `data`, of which `data.episodes` has returns and costs, and the number of
        the run and of its policy for each transition.

    Raises:
        ConfigError: no run folder, no checkpoint yet, runs of different tasks, shares that do not sum
            to 1, another kind of file, or a place where none can be written.
        jaxsafe.run.checkpoint.NotSaved: the disk failed.

    Source: Liu et al. (2023), "Datasets and Benchmarks for Offline Safe Reinforcement Learning",
        arXiv:2306.09303, for the file's arrays.
    """
    out = collecting.data_file(path)
    count, seed = convert(size, collecting.Size, "size"), convert(seed, Seed, "seed")
    shares = [convert(share, float, "a share") for share in runs.values()]
    collecting.check_shares(shares)
    opened = [(run if isinstance(run, Run) else Run(run))._opened for run in runs]
    return collecting.write(out, [*map(Ingredient, opened, shares)], count, seed, sampled)


def evaluate(
    run: Run | str | Path,
    episodes: int = 100,
    seed: int = 1,
    setting: int = 0,
    sampled: bool = False,
) -> Scores:
    """Fresh whole episodes of a run's policies, scripts/evaluate.py as a function.

    Args:
        run: a run, or its folder.
        episodes: of each seed.
        seed: of the episodes. Each seed of the run meets episodes of its own, the same ones in every
            setting and run.
        setting: which one, of a run that trained several side by side.
        sampled: whether actions are sampled, as in training, or the mean ones.

    Returns:
        Printed, a table. `scores.rows` has an estimate (mean, low, high: the 95% interval
        over seeds, or over the episodes of a lone one) of 'return' and 'cost' (undiscounted sums of an
        episode), 'violation rate' (the share of episodes over the limit), 'episode length' (steps of
        the policy), in Safety Gym 'goals' (reached in an episode), 'cost rate (training)' (cost a step
        of the policy) and, where known, Safety Gym's normalised scores;
        `scores.seeds` has the mean of each seed; `scores.calibration`, of a policy under a shield, how
        often its risk came true.

    Raises:
        ConfigError: no run folder, no checkpoint yet, no such setting, or episodes < 1.

    Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
        Learning", section 5, for the measures.
    """
    run = run if isinstance(run, Run) else Run(run)
    episodes, seed = convert(episodes, EpisodeCount, "episodes"), convert(seed, Seed, "seed")
    setting = convert(setting, Index, "setting")
    if not setting < (count := len(run.settings.configs)):
        raise ConfigError(f"setting {setting}: the run has {count}, from 0")
    return evaluation.evaluate(run._opened, episodes, seed, sampled=sampled)[setting]


def render(
    run: Run | str | Path, path: str | Path | None = None, index: int = 0, seed: int = 1
) -> Path:
    """Film one episode of a policy at 30 frames a second, scripts/render.py as a function.

    Args:
        run: a run, or its folder.
        path: an .mp4 or .gif; None is video.mp4 in the run folder.
        index: which policy.
        seed: of the episode.

    Returns:
        The path written.

    Raises:
        ConfigError: no run folder, no checkpoint yet, no such policy, another kind of file, or an
            environment that cannot be drawn: neither Safety Gym's nor a velocity nor a racing task.
        jaxsafe.report.film.NoVideo: this machine can draw nothing: no EGL, OSMesa or display.
    """
    run = run if isinstance(run, Run) else Run(run)
    out = Path(path or run.folder / "video.mp4").expanduser()
    film.check_video(out)
    index, seed = convert(index, Index, "index"), convert(seed, Seed, "seed")
    film.film([run._opened.one(index)], out, film.key_of(seed))
    return out
