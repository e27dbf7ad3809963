"""The command as a user meets it: most in this process, on a toy that compiles in seconds.

A new process is there where one is killed, interrupted or has other devices, and for two commands on a
real environment.
"""

import dataclasses
import itertools
import re
import resource
import shutil
import signal
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from compiling import FAST
from shell import (
    SMALL,
    STEPS,
    TOY,
    assert_same_run,
    call,
    rows,
    start,
    typed,
    wait_for,
)
from toys import START

from jaxsafe import algos, envs
from jaxsafe.config import ConfigError, flat
from jaxsafe.envs.wrap import WrapConfig
from jaxsafe.learn.conventions import conventions
from jaxsafe.run import (
    arguments,
    checkpoint,
    files,
    help,
    hydra_jobs,
    loop,
    policies,
    programs,
    run_folder,
    session,
    settings,
)

END = 40 * STEPS  # total_steps of `finished`


BAD = {
    "env=point_gol1": "did you mean 'point_goal1'?",
    "env=Safexp-PointGoal9-v0": "did you mean",
    "algo=cop": "did you mean 'cpo'?",
    "algo.cost_limt=3": "did you mean 'cost_limit'?",
    "env.hazard_num=3": "did you mean 'hazards_num'?",
    "algo.shield=true_dynamics": "unknown option algo.shield of ppo_lag; ambs has shield",
    "algo.size=12m": "of ppo_lag; ambs, dreamer, dreamer_lag and",
    "env=ant_velocity env.observe_vision=true": "of ant_velocity; point_goal0, point_goal1,",
    "total_step=5": "did you mean 'total_steps'?",
    "cost_limit=5": "did you mean 'algo.cost_limit'?",
    "total_steps=-1": "expected a whole number between 1 and",
    "total_steps=1.5": "expected a whole number",
    "total_steps=many": "expected a whole number",
    "num_envs=0": "expected a whole number between 1 and",
    "num_seeds=0": "expected a whole number between 1 and",
    "seed=-1": "expected a whole number between 0 and",
    "algo.cost_limit=-1": "expected a number between 0 and",
    "algo.discount=1.1": "expected a number between 0 and 1",
    "algo.gae_lambda=nan": "expected a number between 0 and 1",
    "algo.clip=wide": "expected a number",
    "algo.minibatches=7": (
        "algo.minibatches=7: expected a divisor of algo.num_envs * algo.horizon = 20480; "
        "the nearest is 8"
    ),
    "algo=cce_pets algo.elites=513": "algo.elites=513: expected at most algo.plans=512",
    "algo=ambs algo.delta=0.01": "algo.delta=0.01: expected at least 0.07 with algo.shield_rollouts=64",
    "algo=ambs algo.labels=[hazad]": "algo.labels: unknown cost 'hazad'; did you mean 'hazards'?",
    "algo.min_std=0.7": (
        "algo.min_std=0.7: expected less than 0.607, the standard deviation at the start"
    ),
    "algo.min_std=[0,0.7]": "min_std=0.7: expected less than 0.607",
    "algo.cost_limit=[5,5]": "algo.cost_limit=5 occurs twice",
    "algo.cost_limit=[]": "not 0 of algo.cost_limit",
    "algo.cost_limit=[5,wide]": "expected a number",
    "env.engine=quick": "quick",
    "env.hazards_num=many": "hazards_num",
    "env.placements_extents=[1,2]": "placements_extents",
    "num_envs=1e7": "use fewer num_envs",
    "num_envs=1e6 env.observe_vision=true algo.encoder=cnn": "num_envs or a smaller env.vision_size",
    "algo=sac_lag algo.replay_size=1e9 env.observe_vision=true algo.encoder=cnn": (
        "use a smaller algo.replay_size or env.vision_size"
    ),
    "algo=sac_lag algo.replay_size=1e9 env.observe_vision=true algo.encoder=cnn num_seeds=2": (
        "use a smaller algo.replay_size, env.vision_size or num_seeds"
    ),
    "num_envs=1e9": "expected a whole number between 1 and 16777216",
    "devices=512": "devices=512",
    "seed=1,2": "--multirun",
    "+seed=1": "without '+'",
    "-m hydra.sweeper.params={algo.lr:1}": "an option takes its values itself, as in -m algo.lr=1,2",
    "-m ++hydra.sweeper.params={seed:'1,2'} hydra/sweeper=basic": "algo.lr=1,2",
    "-m +hydra.sweeper.params.algo.lr=1,2": "algo.lr=1,2",
    "-m hydra.sweeper.params.algo.lr='1,2'": "algo.lr=1,2",
    "-m --config-dir=. +hydra.sweeper.params.seed='1,2'": "algo.lr=1,2",
    "hydra.sweeper.params={algo:'ppo,sac'}": "algo.lr=1,2",
    "seed": "cannot read",
    "algo.clip=[1": "cannot read",
    "preset=quick": "valid: auto, early_price, fast",
    "compat=omnisaf": "did you mean 'omnisafe'?",
    f"run_dir={'long' * 70}": "at most 255 bytes",
    "resume=nowhere": "not a run folder",
    "init_from=nowhere": "not a run folder",
    "env.name=point_goal1": "choose with env=",
    "--fast": "unknown flag --fast",
}


@pytest.mark.parametrize("argument", BAD)
def test_bad_input_is_one_line_and_status_2(argument, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(loop, "train", lambda *a, **k: pytest.fail("it went on to train"))
    assert typed("train", *argument.split()) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and BAD[argument] in lines[0]
    assert not list(tmp_path.glob("runs/*"))


def test_a_new_process_reports_bad_input_the_same_way(tmp_path, capsys):
    status, out, err = call("train", "algo.clip=wide", cwd=tmp_path)
    assert (status, out, err) == (
        2,
        "",
        "error: algo.clip='wide': expected a number between 1e-06 and 100\n",
    )
    assert typed("train", "-m", "--cfg", "job") == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: Only one of") and err.count("\n") == 1


def test_help_and_cfg_show_every_option_with_its_default(capsys):
    assert not typed("train", "--help")
    out = capsys.readouterr().out
    assert "env=car_push1 algo=cpo" in out and max(map(len, out.splitlines())) <= 100
    assert not typed("train", "env=hopper_velocity", "algo=cpo", "-h")
    other = capsys.readouterr().out
    for shown, env, algo in ((out, "point_goal1", "ppo_lag"), (other, "hopper_velocity", "cpo")):
        known = settings.defaults_of({}, {"env": env, "algo": algo})
        for name in flat(known):
            assert f"\n  {name}=" in shown or name.endswith(".name"), name
    line = next(line for line in other.splitlines() if line.startswith("  algo.violation_gain=5.0"))
    assert line.endswith("A step is asked to take back this many times v.")
    texts = ["env=Safexp-CarPush1-v0", "algo=cpo", "total_steps=1e7"]
    assert not typed("train", "--cfg", "job", *texts, "env.placements_extents=[-1,-1,1,1]")
    shown = yaml.safe_load(capsys.readouterr().out)
    assert shown["env"]["name"] == "car_push1" and shown["algo"]["name"] == "cpo"
    assert shown["env"]["placements_extents"] == [-1, -1, 1, 1]
    assert shown["env"].keys() - {"name"} == envs.env_defaults("car_push1").keys()


def test_every_option_says_what_it_is():
    tasks = [envs.SafetyGymConfig, envs.VelocityConfig, envs.CarRacing]
    tasks += [envs.Pendulum, envs.CartPendulum, WrapConfig]
    for config in (settings.TrainConfig, *tasks, *(row.config for row in algos.ALGOS.values())):
        notes = help.comments(config)
        assert all(notes[field.name] for field in dataclasses.fields(config)), config
    assert help.comments(envs.SafetyGymConfig)["num_steps"] == "time limit", "without the divider above"


def test_published_settings_are_defaults_that_the_command_line_overrides():
    request = hydra_jobs.check_arguments(["preset=published", "algo=cpo"])
    setting = next(iter(algos.ALGOS["cpo"].published.values()))
    assert request.groups["algo"]["cpo"].items() >= setting.items()


def test_a_run_is_as_long_as_its_algorithm_asks_unless_told():
    for texts, steps in ((["algo=cpo"], 10_000_000), (["algo=sac_lag"], 5_000_000)):
        assert arguments.compose(texts).train.total_steps == steps
        assert arguments.compose([*texts, "preset=published"]).train.total_steps == steps
        assert arguments.compose([*texts, "total_steps=64"]).train.total_steps == 64


def test_every_chosen_name_has_its_options_and_no_other():
    texts = ["-m", "env=car_push1,Safexp-PointGoal1-v0", "algo=pcpo,trpo"]
    groups = hydra_jobs.check_arguments(texts).groups
    chosen = {group: {name for name, options in g.items() if options} for group, g in groups.items()}
    assert chosen == {"env": {"car_push1", "point_goal1"}, "algo": {"pcpo", "trpo"}}


def test_the_conventions_of_omnisafe_are_defaults_of_either_preset():
    for preset in ("fast", "published"):
        texts = [f"preset={preset}", "compat=omnisafe", "algo=cpo", "algo.margin_lr=0.1"]
        found = arguments.compose(texts)
        cfg = found.algo
        assert (cfg.per_step, cfg.violation_gain, cfg.margin_lr) == (False, 1.0, 0.1)
        assert (cfg.kl_per_action, cfg.target_kl, cfg.cost_window) == (True, 0.01, 5)
        assert found.plain()["compat"] == "omnisafe"


def test_each_convention_differs_from_the_defaults_of_every_algorithm_that_has_it():
    for row in algos.ALGOS.values():
        for convention in conventions(row.config):
            assert all(getattr(row.config(), k) != v for k, v in convention.options.items())


@pytest.fixture(scope="module")
def real(tmp_path_factory) -> tuple[Path, str]:
    """A run of Safety Gym on engine c by the script itself, and what it printed."""
    home = tmp_path_factory.mktemp("real")
    args = ("env=point_goal0", "env.num_steps=20", *SMALL[1:], f"total_steps={2 * STEPS}")
    status, out, err = call("train", *args, "run_dir=run", cwd=home)
    assert status == 0, err
    return home / "run", out


def test_a_run_folder_holds_what_a_reader_needs(real):
    run, out = real
    first = out.splitlines()[0]
    assert all(
        s in first for s in ("point_goal0", "ppo_lag", "1 seed x 4 envs", "engine c", "compiling")
    )
    assert re.search(r"compiled in [\d.]+ s; an iteration is \d+ steps\n", out)
    assert f"run folder: {run.name}" in out
    for name in ("config.yaml", "versions.json", "metrics.csv", "curves.png", "evaluation.json"):
        assert (run / name).stat().st_size > 0
    assert list(run.glob("tensorboard/seed0/events*"))
    done = run_folder.newest_progress(run)
    assert done is not None and done[:2] == (2, 2 * STEPS)
    assert [p for p in run.rglob("*") if p.suffix in (".pkl", ".pickle", ".npy")] == []
    saved = run_folder.read_config(run)
    assert settings.settings_from_config(saved).plain() == saved


def test_evaluate_prints_the_table(real, tmp_path):
    status, out, err = call("evaluate", str(real[0]), "--episodes", "3", cwd=tmp_path)
    assert status == 0, err
    for row in ("return", "cost", "violation rate", "cost rate"):
        assert any(line.startswith(row) for line in out.splitlines())


def test_killed_and_resumed_it_ends_bit_for_bit_as_if_uninterrupted(
    finished, tmp_path, monkeypatch, capsys
):
    args, run = (*SMALL, f"total_steps={END}", "run_dir=run"), tmp_path / "run"
    process = start("train", *args, "checkpoint_iterations=1", cwd=tmp_path)
    wait_for(lambda: len(checkpoint.checkpoints(run / "checkpoints")) == 2, process)
    process.kill()
    process.communicate()
    reached = run_folder.newest_progress(run)
    assert reached is not None and 0 < reached[0] < 40, "killed too late to test anything"
    monkeypatch.chdir(tmp_path)
    assert typed("train", *args, "resume=true") == 0
    assert "resuming at" in capsys.readouterr().out
    assert_same_run(run, finished)


def test_a_resumed_run_with_a_later_end_goes_on_at_the_rates_of_that_end(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    decaying = (*SMALL, "run_dir=run", "algo.lr_decay=true", "eval_episodes=0")
    assert typed("train", *decaying, f"total_steps={2 * STEPS}") == 0
    assert typed("train", "resume=run", TOY, f"total_steps={4 * STEPS}") == 0
    kl = run_folder.read_metrics(tmp_path / "run")["train/kl"]
    assert len(kl) == 4 and (kl > 0).all()  # at a rate of 0 the policy would not move


def test_ctrl_c_saves_and_says_how_to_resume_and_that_works(finished, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    process = start("train", *SMALL, "run_dir=run", "total_steps=1e8", cwd=tmp_path)
    wait_for(lambda: (run / "metrics.csv").exists() and len(rows(run)) > 2, process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and err == ""
    assert f"python scripts/train.py resume=run {TOY}" in out
    reached = run_folder.newest_progress(run)
    assert reached is not None
    monkeypatch.chdir(tmp_path)
    assert typed("train", "resume=run", TOY, f"total_steps={reached.steps + STEPS}") == 0
    assert "resuming at" in capsys.readouterr().out
    assert run_folder.newest_progress(run) == (reached[0] + 1, reached[1] + STEPS, reached[2] + 4)
    table, reference = rows(run), rows(finished)
    compared = min(len(table), len(reference))
    assert table[:compared] == reference[:compared]
    assert [row[0] for row in table[1:]] == [str(i + 1) for i in range(reached[0] + 1)]


def test_ctrl_c_during_the_evaluation_leaves_a_run_that_is_trained(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    (run / "curves.png").unlink(missing_ok=True)  # it is drawn right before the evaluation
    process = start("train", "resume=run", TOY, "eval_episodes=200000", cwd=tmp_path)
    wait_for((run / "curves.png").exists, process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and err == ""
    assert "the training is saved" in out and "python scripts/train.py resume=run" in out


def settled(*args: str, **algo: Any) -> settings.Settings:
    """The toy's settings with top-level options as a config.yaml has them."""
    base = {k: yaml.safe_load(v) for k, v in (a.split("=") for a in args)}
    settings.load("env", "toys:Corridor")
    groups = {"env": {"name": "toys:Corridor"}, "algo": {"name": "ppo_lag", **algo}}
    return settings.settings_from_config({**groups, **base})


def test_a_folder_with_a_run_is_not_overwritten_nor_resumed_with_other_settings(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    with pytest.raises(ConfigError, match="resume=true"):
        session.choose_folder(settled(f"run_dir={run}"), None, print)
    saved = settings.settings_from_config(run_folder.read_config(run) | {"resume": str(run)})
    assert session.choose_folder(saved, None, print) == run
    longer = settings.settings_from_config(
        run_folder.read_config(run) | {"resume": str(run), "total_steps": 10**6}
    )
    assert session.choose_folder(longer, None, print) == run
    other = settings.settings_from_config(run_folder.read_config(run) | {"resume": str(run), "seed": 5})
    with pytest.raises(ConfigError, match=r"seed=5 but .* was trained with 0"):
        session.choose_folder(other, None, print)
    same = saved._replace(train=dataclasses.replace(saved.train, run_dir=f"{tmp_path}/./run"))
    assert session.choose_folder(same, None, print) == run
    two = saved._replace(train=dataclasses.replace(saved.train, run_dir="elsewhere"))
    with pytest.raises(ConfigError, match=r"run_dir=elsewhere: resume=.* goes on in that folder"):
        session.choose_folder(two, None, print)
    shutil.rmtree(run / "checkpoints")  # what is left of a run is not overwritten either
    with pytest.raises(ConfigError, match="already holds a run"):
        session.choose_folder(settled(f"run_dir={run}"), None, print)


def test_num_envs_and_algo_num_envs_are_one_number_to_a_resumed_run(tmp_path):
    """By whichever name it had it then, and has it now."""
    for first, then in itertools.product(("num_envs", "algo.num_envs"), repeat=2):
        run = tmp_path / f"{first},{then}"
        run.mkdir()
        run_folder.write_config(
            run, settings.settings_from_options(settings.nested({first: 64})).plain()
        )
        same, other = (
            settings.settings_from_options(settings.nested({"resume": str(run), then: count}))
            for count in (64, 16)
        )
        assert session.choose_folder(same, None, print) == run
        with pytest.raises(ConfigError, match=r"algo.num_envs=16 but .* was trained with 64"):
            session.choose_folder(other, None, print)


@pytest.mark.parametrize(
    "given, refused",
    [
        (f"total_steps={END - STEPS}", f"total_steps={END - STEPS}: FOLDER has {END:,} steps already"),
        ("total_updates=7", "total_updates=7: FOLDER has 160 updates already"),
    ],
)
def test_a_run_is_not_resumed_to_end_before_where_it_is(finished, tmp_path, capsys, given, refused):
    run = shutil.copytree(finished, tmp_path / "run")
    config = (run / "config.yaml").read_bytes()
    refused = f"error: {refused.replace('FOLDER', str(run))}; expected at least as many\n"
    for how in ((f"resume={run}", TOY), (*SMALL, f"run_dir={run}", "resume=true")):
        assert typed("train", *how, given) == 2
        assert capsys.readouterr().err == refused
    assert (run / "config.yaml").read_bytes() == config
    # the last iteration may be beyond the end by less than itself
    within = run_folder.read_config(run) | {"resume": str(run), "total_steps": END - STEPS + 1}
    assert session.choose_folder(settings.settings_from_config(within), None, print) == run


def test_a_policy_that_a_kill_left_unwritten_is_written_when_resumed(finished, tmp_path, capsys):
    run = shutil.copytree(finished, tmp_path / "run")
    newest, *_ = checkpoint.checkpoints(run / "policy")
    shutil.rmtree(newest)
    assert typed("train", f"resume={run}", TOY) == 0
    assert "nothing left to train" in capsys.readouterr().out
    assert run_folder.newest_progress(run, "policy") == run_folder.newest_progress(run)


def test_a_run_has_one_process_at_a_time(finished, tmp_path, capsys):
    run = shutil.copytree(finished, tmp_path / "run")
    before = (run / "versions.json").read_bytes()
    resume = ("train", f"resume={run}", TOY, f"total_steps={41 * STEPS}")
    with files.held(run):  # as a second process would; it lets go when that ends, however it ends
        assert typed(*resume) == 2
    assert f"another process is training in {run}" in capsys.readouterr().err
    assert (run / "versions.json").read_bytes() == before
    assert typed(*resume) == 0


def test_resume_true_finds_the_newest_unfinished_run_of_the_same_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wanted = settled("seed=1", "resume=true")
    for name, seed in (
        ("20260101-000000-seed1", 1),
        ("20260102-000000-seed1", 1),
        ("20260103-000000-seed2", 2),
    ):
        folder = tmp_path / "runs" / "toys.Corridor-ppo_lag" / name
        folder.mkdir(parents=True)
        run_folder.write_config(folder, settled(f"seed={seed}").plain())
    assert session.choose_folder(wanted, None, print).name == "20260102-000000-seed1"


@pytest.mark.parametrize("name", ["ppo_lag", "ppo_simmer_pid"])
def test_the_policy_of_a_run_is_read_whatever_its_minibatches_divide(tmp_path, name):
    """Only the whole batch, 8 x 5, divides by 4: one environment's steps do not."""
    sizes = {"num_envs": 8, "horizon": 5, "minibatches": 4, "hidden": [8, 8]}
    run = settled(name=name, **sizes)
    env = settings.make_env(run)
    program = programs.build(env, run.row.make, run.configs, run.train)
    ones = jax.tree.map(
        lambda x: np.ones(x.shape, x.dtype),
        program.learned(jax.eval_shape(program.init, program.start, START)),
    )
    run_folder.write_config(tmp_path, run.plain())
    checkpoint.save(tmp_path / "policy", ones, checkpoint.Progress(1, 40, 4))
    algo, learned = policies.member_policies(run, env, tmp_path)
    learned = jax.tree.map(lambda x: x[0], learned)
    action, _, _ = algo.policy.act(learned, (), jnp.zeros(algo.task(learned).obs_size), None)
    assert action.shape == (env.action_size,)
    assert learned.config.cost_limit == 25.0  # `task` may need the settings, and the dual
    assert all(
        (x == 1).all() for x in jax.tree.leaves((learned.params, learned.normaliser, learned.dual))
    )


def test_evaluate_render_and_watch_refuse_a_bad_folder_in_one_line(tmp_path, capsys):
    for script in ("evaluate", "render", "watch"):
        assert typed(script, str(tmp_path)) == 2
        assert (
            capsys.readouterr().err == f"error: {tmp_path} is not a run folder: it has no config.yaml\n"
        )


def test_no_folder_is_made_for_a_film_of_a_run_that_there_is_not(tmp_path, capsys):
    for more in ((), ("--out", str(tmp_path / "films" / "a.mp4"))):
        assert typed("render", str(tmp_path / "nowhere"), *more) == 2
        assert "nowhere is not a run folder" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


def test_evaluate_takes_one_run(tmp_path, capsys):
    run = tmp_path / "run"
    run.mkdir()
    run_folder.write_config(run, {"env": {"name": "point_goal1"}, "algo": {"name": "cpo"}})
    assert typed("evaluate", str(run), "runs/b") == 2
    said = capsys.readouterr().err
    assert said.startswith("error: runs/b: expected one run folder, and") and said.count("\n") == 1
    assert typed("evaluate", str(run), "env.observe_vision=true") == 2
    assert "vision=true: with a run, expected env=MODULE:NAME or" in capsys.readouterr().err
    assert typed("evaluate") == 2
    assert capsys.readouterr().err == "error: the following arguments are required: RUN\n"


def test_a_full_disk_ends_training_in_one_line(tmp_path):
    """A limit on file size stands in for the disk: checkpoints and Matplotlib's list of fonts fit,
    metrics soon do not."""
    args = (*SMALL, "run_dir=run", "total_steps=1e8", "checkpoint_iterations=20")
    never = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "1e9"}  # its files would not fit either
    process = start("train", *args, cwd=tmp_path, **never)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (80_000, 80_000))
    _, err = process.communicate(timeout=200)
    assert process.returncode == 1
    assert re.fullmatch(r"error: File too large \(run/\S+\); what was saved stays\n", err)
    assert checkpoint.load(tmp_path / "run" / "checkpoints")[1].at.iteration > 0


@pytest.mark.parametrize("num_seeds", [1, 2])
def test_seeds_and_environments_split_over_devices(finished, tmp_path, monkeypatch, capsys, num_seeds):
    args = (*SMALL, f"total_steps={END}", "run_dir=run", "devices=2", f"num_seeds={num_seeds}")
    status, _, err = call("train", *args, cwd=tmp_path, JAX_NUM_CPU_DEVICES="2")
    assert status == 0, err
    table = run_folder.read_metrics(tmp_path / "run")
    assert sorted(set(table["seed"])) == list(range(num_seeds)) and table["steps"].max() == END
    assert typed("evaluate", str(tmp_path / "run"), TOY, "--episodes", "2") == 0
    assert f"{num_seeds} x 2 episodes" in capsys.readouterr().out
    if num_seeds == 2:  # a seed of the sweep is the lone run of that seed
        lone = run_folder.read_metrics(finished)
        for name in table.keys() - {"seconds"}:
            np.testing.assert_allclose(
                table[name][0], lone[name][0], rtol=1e-3, atol=1e-4, err_msg=name
            )


def policy_rows(run: Path) -> dict[str, np.ndarray]:
    arrays = checkpoint.load(run / "checkpoints")[0]
    return {k: v for k, v in arrays.items() if k.split(".")[0] in policies.POLICY}


def warm(*args: str, **algo: Any):
    """A train state of ppo without an update, before and after it takes over a policy."""
    sizes = {"num_envs": 2, "horizon": 4, "minibatches": 1, "hidden": [8, 8]}
    settings.load("env", "toys:Ticker")
    run = settled(*args, **{"name": "ppo", **sizes, **algo})
    said: list[str] = []
    _, program = session.prepare(run)
    adapt = policies.warm_start(run, program, said.append)
    fresh = jax.jit(program.init, compiler_options=FAST)(program.start, START)
    return checkpoint.to_arrays(fresh), checkpoint.to_arrays(adapt(fresh)), said[0]


def test_a_run_starts_from_the_parameters_and_normaliser_of_another_and_nothing_else(finished):
    policy = policy_rows(finished)
    fresh, taken, said = warm(f"init_from={finished}", "num_seeds=2", cost_limit=[1.0, 2.0])
    assert {name.split(".")[0] for name in policy} == set(policies.POLICY)
    for name, value in taken.items():
        expected = np.repeat(policy[name], 4, axis=0) if name in policy else fresh[name]
        np.testing.assert_array_equal(value, expected, err_msg=name)
    assert said == f"starting from {finished}: seed 0 from its seed 0, 1 from its seed 0"
    kernel = "params.actor.mean.params.Dense_0.kernel"
    counts = [x for name, x in taken.items() if name.startswith("opt_state") and name.endswith("count")]
    assert (fresh[kernel] != taken[kernel]).any() and counts and not any(x.any() for x in counts)


def test_each_seed_starts_from_the_same_seed_where_there_is_one(finished, tmp_path):
    source = tmp_path / "run"
    source.mkdir()
    run_folder.write_config(source, run_folder.read_config(finished) | {"seed": 4, "num_seeds": 3})
    three = {k: np.concatenate([v, v + 1, v + 2]) for k, v in policy_rows(finished).items()}
    checkpoint.save(source / "checkpoints", three, checkpoint.Progress(1, 64, 4))
    _, taken, said = warm(f"init_from={source}", "seed=5", "num_seeds=3")
    for name, value in three.items():
        np.testing.assert_array_equal(taken[name], value[[1, 2, 0]])
    assert said.endswith("seed 5 from its seed 5, 6 from its seed 6, 7 from its seed 4")


@pytest.mark.parametrize(
    ("args", "algo", "expected"),
    [
        ((), {"hidden": [4]}, ("is [8], expected [4]; algo.hidden is [8, 8] there, [4] here",)),
        ((), {"obs_normalize": False}, ("expected absent", "algo.obs_normalize is True there")),
        ((), {"activation": "relu"}, ("algo.activation is tanh there, relu here",)),
        ((), {"trunk": "shared"}, ("algo.trunk is separate there, shared here",)),
        ((), {"std": "state"}, ("is [2], expected [4]; algo.std is free there, state here",)),
        (
            ('env={name: "toys:Ticker"}',), {},
            ("[4", "[3", "env.name is toys:Corridor there, toys:Ticker here"),
        ),
    ],
)  # fmt: skip
def test_a_policy_of_another_kind_is_refused_by_what_differs(finished, args, algo, expected):
    with pytest.raises(ConfigError) as error:
        warm(f"init_from={finished}", *args, **algo)
    assert all(part in str(error.value) for part in ("does not fit", *expected)), error.value
    assert "\n" not in str(error.value)


def test_a_run_without_checkpoint_is_no_policy_to_start_from(tmp_path):
    run_folder.write_config(tmp_path, settled().plain())
    with pytest.raises(ConfigError, match="holds no checkpoint"):
        warm(f"init_from={tmp_path}")


def test_a_resumed_run_does_not_start_from_the_other_policy_again(
    finished, tmp_path, monkeypatch, capsys
):
    source = tmp_path / "source"
    shutil.copytree(finished, source)
    monkeypatch.chdir(tmp_path)
    args = (*SMALL, "run_dir=run", "init_from=source")
    assert typed("train", *args, f"total_steps={2 * STEPS}") == 0
    assert "starting from source" in capsys.readouterr().out
    shutil.rmtree(source)
    assert typed("train", *args, f"total_steps={4 * STEPS}", "resume=true") == 0
    assert "starting from" not in capsys.readouterr().out
    assert run_folder.read_config(tmp_path / "run")["init_from"] == "source"
    assert run_folder.newest_progress(tmp_path / "run") == (4, 4 * STEPS, 16)


@pytest.mark.parametrize(
    "task, algo, preset",
    [
        ("walker2d_velocity", "ppo_lag", "frequent"),
        ("SafetyWalker2dVelocity-v1", "ppo_lag", "frequent"),
        ("hopper_velocity", "cppo_pid", "parallel"),
        ("humanoid_velocity", "cppo_pid", "parallel"),
        ("swimmer_velocity", "trpo_lag", "early_price"),
        ("swimmer_velocity", "ppo_lag", "early_price"),
        ("swimmer_velocity", "ppo", "frequent"),
        ("humanoid_velocity", "ppo_lag", "parallel"),
        ("humanoid_velocity", "trpo_lag", "frequent"),
        ("car_push1", "cpo", "entropy"),
        ("car_push1", "pcpo", "fast"),
        ("hopper_velocity", "ppo_lag", "fast"),
        ("hopper_velocity", "pcpo", "fast"),
        ("ant_velocity", "td3_lag", "decay"),
        ("point_button1", "sac_lag", "navigation"),
        ("point_goal1", "sac_lag", "fast"),
    ],
)
def test_a_run_has_the_preset_that_suits_its_task_unless_it_names_one(task, algo, preset):
    chosen = [f"env={task}", f"algo={algo}"]
    found = arguments.compose(chosen)
    for named in ("auto", preset):
        assert arguments.compose([*chosen, f"preset={named}"]).plain() == found.plain()
    assert found.train.preset == preset
    assert arguments.compose([*chosen, "preset=fast"]).algo == algos.ALGOS[algo].config()
    assert (preset in session.about_preset(found)) == (preset != "fast")
    assert settings.settings_from_config(found.plain()).plain() == found.plain()
    unnamed = {k: v for k, v in found.plain().items() if k != "preset"}
    assert settings.settings_from_config(unnamed).train.preset == "fast"


def test_tasks_of_a_sweep_must_have_one_preset_of_an_algorithm():
    several = ["-m", "env=walker2d_velocity,ant_velocity"]
    with pytest.raises(ConfigError, match=r"frequent on walker2d_velocity, fast on ant_velocity; give"):
        hydra_jobs.check_arguments([*several, "algo=ppo"])
    assert hydra_jobs.check_arguments([*several, "algo=ppo", "preset=fast"]).base["preset"] == "fast"
    assert hydra_jobs.check_arguments([*several, "algo=sac"]).base["preset"] == "fast"
    each = hydra_jobs.check_arguments(
        ["-m", "env=walker2d_velocity", "algo=ppo,sac", "total_steps=1e6"]
    )
    assert each.base["preset"] == "auto" and each.groups["algo"]["ppo"]["horizon"] == 160


def test_algorithms_of_a_sweep_must_have_one_length():
    with pytest.raises(ConfigError, match=r"10,000,000 of ppo, 5,000,000 of sac by default; give one"):
        hydra_jobs.check_arguments(["-m", "algo=ppo,sac"])
    for length in (["total_steps=1e6"], ["total_steps=1e6,2e6"]):
        hydra_jobs.check_arguments(["-m", "algo=ppo,sac", *length])


@pytest.mark.parametrize(
    "options",
    [
        ["+hydra.sweeper.ax_config={params: {env: {type: choice, values: [ant_velocity]}}}"],
        ["+hydra.sweeper.ax_config.params.algo={type: choice, values: [ppo, sac]}"],
        ["--config-dir=conf", "hydra/sweeper=mine"],
        ["--config-dir=conf", "hydra/sweeper=mine", "hydra.sweeper.params={env: 'ant_velocity'}"],
    ],
)
def test_a_sweeper_that_may_choose_any_task_has_the_general_defaults_or_those_of_the_run_to_continue(
    tmp_path, options
):
    texts, sweeper = ["env=walker2d_velocity", "algo=ppo"], ["-m", *options]
    assert hydra_jobs.check_arguments([*sweeper, *texts]).base["preset"] == "fast"
    run_folder.write_config(tmp_path, arguments.compose(texts).plain())
    assert hydra_jobs.check_arguments([*sweeper, f"resume={tmp_path}"]).base["preset"] == "frequent"
    with pytest.raises(ConfigError, match="preset=auto: a sweeper may choose any task"):
        hydra_jobs.check_arguments([*sweeper, *texts, "preset=auto"])


@pytest.mark.parametrize(
    "options",
    [
        ["-m", "hydra.sweeper.max_batch_size=1"],
        ["-m", "+hydra.sweeper.ax_config={params: {algo.clip: {type: range, bounds: [0.1, 0.2]}}}"],
        ["-m", "hydra/sweeper=basic"],
        ["hydra.verbose=true"],
    ],
)
def test_options_of_hydra_that_choose_no_task_leave_it_its_preset(options):
    texts = [*options, "env=walker2d_velocity", "algo=ppo"]
    request = hydra_jobs.check_arguments(texts)
    assert request.base["preset"] == "frequent" and request.groups["algo"]["ppo"]["horizon"] == 160
    hydra_jobs.check_arguments([*texts, "preset=auto"])  # is not refused
