"""Commands of AMBS and of ALF, as they stand in their READMEs."""

import dataclasses
import shlex

import pytest
from shell import typed

from jaxsafe.config import ConfigError
from jaxsafe.interop.migrate.from_commands import alf, ambs
from jaxsafe.learn.observations import observation_like
from jaxsafe.run.arguments import compose
from jaxsafe.run.settings import make_env

AMBS = (
    "python train.py --logdir ./logdir/shield_plpg --configs safetygym_vision large "
    "--task safetygym_Safexp-PointGoal1-v0 --penalty_coeff 0.8 --plpg True --normalise_ret False "
    "--penl_critic_type vfunction --run.steps 500000 --seed 3"
)
ALF = (
    "python -m alf.bin.train --root_dir=job --conf safety/seditor/seditor_safety_gym_conf.py "
    "--conf_param=\"create_environment.env_name='Safexp-CarButton2-v0'\" "
    "--conf_param 'TrainerConfig.random_seed=7'"
)


def test_a_command_of_ambs_keeps_task_seed_frames_and_penalty():
    found = ambs(AMBS)
    settings = compose(found.argv)
    assert (settings.env_name, settings.train.seed) == ("point_goal1", 3)
    assert settings.train.total_steps == 1_000_000  # frames: its steps have two raw ones
    assert settings.env_options["wrap"]["action_repeat"] == 2
    assert not [line for line in found.lines if line.lost]
    assert settings.algo_name == "ambs" and settings.algo.imagine_steps == 15
    assert (settings.algo.penalty, settings.algo.penalty_coef) == ("plpg", 0.8)
    penl = ambs(AMBS.replace("--plpg True --normalise_ret False", "--normalise_ret True"))
    assert compose(penl.argv).algo.penalty == "penl"
    assert {line.key for line in penl.lines if line.lost} == {"normalise_ret"}


def test_a_command_of_ambs_sees_what_its_configs_say():
    """Pictures of 64 x 64 and nothing else, or vectors."""
    settings = compose(ambs(AMBS).argv)
    cfg = settings.algo
    assert (cfg.encoder, cfg.size, cfg.replay_ratio) == ("cnn", "large", 512)
    seen = observation_like(make_env(settings))
    assert seen["vision"].shape == (64, 64, 3) and seen["vector"].shape == (0,)
    for configs, lost in (("safetygym", []), ("safetygym_lambda", ["configs"])):
        vectors = ambs(AMBS.replace("safetygym_vision large", configs))
        cfg = compose(vectors.argv).algo
        assert (cfg.encoder, cfg.size, cfg.replay_ratio) == ("none", "small", 64)
        assert [line.key for line in vectors.lines if line.lost] == lost


def test_a_command_of_alf_keeps_task_seed_and_seditor_s_settings():
    found = alf(ALF)
    settings = compose(found.argv)
    assert (settings.env_name, settings.algo_name) == ("seditor_car_button2", "seditor")
    assert (settings.train.seed, settings.algo.num_envs, settings.algo.replay_ratio) == (7, 32, 51.2)
    assert (settings.train.total_steps, settings.algo.cost_limit) == (5_000_000, 0.5)
    assert settings.env_options["wrap"]["frame_stack"] == 4
    assert not [line for line in found.lines if line.lost]
    alone = alf(ALF.replace("seditor_safety_gym_conf", "sac_safety_gym_conf"))
    assert compose(alone.argv).algo == dataclasses.replace(settings.algo, edit="none")
    assert not [line for line in alone.lines if line.lost]


def test_a_command_of_alf_in_racing_sees_pictures():
    racing = "python -m alf.bin.train --conf safety/seditor/seditor_safe_car_racing_conf.py"
    found = alf(racing)
    settings = compose(found.argv)
    assert (settings.env_name, settings.algo.num_envs, settings.algo.encoder) == (
        "car_racing1",
        16,
        "cnn",
    )
    assert observation_like(make_env(settings))["vision"].shape == (96, 96, 1)
    assert not [line for line in found.lines if line.lost]
    level = compose(
        alf(racing + " --conf_param \"create_environment.env_name='SafeCarRacing0-v0'\"").argv
    )
    assert (level.env_name, level.algo) == ("car_racing0", settings.algo)
    alone = compose(alf(racing.replace("seditor", "sac")).argv)
    assert alone.algo == dataclasses.replace(settings.algo, edit="none")


@pytest.mark.parametrize(
    "migrate, command, says",
    [
        (ambs, "python train.py --task atari_seaquest", "we have Safety Gym's"),
        (ambs, "python train.py --task 5", "--task 5 has no counterpart"),
        (ambs, "python train.py --task safetygym_Safexp-PointGoal9-v0", "did you mean"),
        (ambs, "python train.py --run.steps 5", "names no task: expected --task"),
        (ambs, AMBS.replace("500000", "many"), "--run.steps='many': expected a whole number"),
        (ambs, AMBS.replace("--seed 3", "--seed -3"), "--seed=-3: expected a whole number between 0"),
        (ambs, 'python train.py --task "', "cannot read the command"),
        (alf, "python -m alf.bin.train --conf atari_conf.py", "expected SEditor's"),
        (
            alf,
            ALF.replace("CarButton2", "CarGoal0"),
            "is no task of SEditor's; did you mean 'car_goal",
        ),
        (alf, "python -m alf.bin.train --conf focops_safe_car_racing_conf.py", "expected SEditor's"),
        (alf, ALF.replace("random_seed=7", "num_env_steps=0"), "total_steps=0: expected"),
    ],
)
def test_what_has_no_counterpart_at_all_is_one_line(migrate, command, says):
    with pytest.raises(ConfigError) as error:
        migrate(command)
    assert says in str(error.value) and "\n" not in str(error.value)


def test_an_unknown_flag_is_named_with_the_nearest():
    lines = ambs(AMBS + " --penalty_coef 2").lines
    (line,) = [line for line in lines if line.key == "penalty_coef"]
    assert line.lost and "did you mean 'penalty_coeff'" in line.text


@pytest.mark.parametrize("source, command, lost", [("ambs", AMBS, 0), ("alf", ALF, 0)])
def test_the_command_prints_what_to_type_and_what_is_lost(source, command, lost, capsys):
    assert typed("migrate", source, command) == 0
    out, err = capsys.readouterr()
    assert compose(shlex.split(out)[2:]).train.seed in (3, 7)
    assert err.count("no counterpart: ") == lost
