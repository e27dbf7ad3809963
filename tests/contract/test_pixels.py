"""Learning from pictures: which algorithms do, what they keep of a picture, and that they learn."""

import dataclasses
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import TINY
from toys import START, Corridor, Patch

from jaxsafe.algos import ALGOS
from jaxsafe.config import ConfigError
from jaxsafe.learn.observations import EncoderConfig, check_observation, observation_like
from jaxsafe.learn.offline import data_set
from jaxsafe.run.dataset import read_dataset, write_dataset
from jaxsafe.types import Shared

REPLAY: dict[str, Any] = {
    "num_envs": 32,
    "horizon": 8,
    "learn_every": 2,
    "batch_size": 128,
    "replay_size": 8192,
    "learning_starts": 256,
    "hidden": (32,),
    "discount": 0.5,
    "lr": 1e-3,
    "critic_lr": 1e-3,
    "encoder": "cnn",
}


def takes_pictures(name: str) -> bool:
    config = ALGOS[name].config
    return issubclass(config, EncoderConfig) and config.TAKES_PICTURES


def test_the_listed_algorithms_take_pictures_and_all_others_refuse_them_in_one_line():
    listed = {"ppo_lag", "cpo", "trpo_lag", "focops", "sac_lag", "td3_lag", "bc"}
    assert listed <= {name for name in ALGOS if takes_pictures(name)}
    seen, vector = observation_like(Patch()), observation_like(Corridor())
    for name, row in ALGOS.items():
        cfg = row.config()
        check_observation(vector, cfg)
        reason = "encoder=none: expected cnn" if takes_pictures(name) else "takes vectors"
        with pytest.raises(ConfigError, match=reason):
            check_observation(seen, cfg)
    cnn = ALGOS["ppo_lag"].config(encoder="cnn")
    check_observation(seen, cnn)
    with pytest.raises(ConfigError, match="encoder=cnn: expected none, as the environment shows none"):
        check_observation(vector, cnn)
    with pytest.raises(ConfigError, match="observation_flatten=false: expected true"):
        check_observation({"goal_lidar": vector, "vision": seen["vision"]}, cnn)
    with pytest.raises(ConfigError, match="trunk=gru: expected separate or shared"):
        ALGOS["ppo_lag"].make(Patch()).clocks(dataclasses.replace(cnn, trunk="gru"))
    refused = ALGOS["seditor"]
    with pytest.raises(ConfigError, match="takes vectors"):
        jax.eval_shape(lambda: refused.make(Patch()).init(jax.random.key(0), refused.config(), START))


ON_POLICY = [("ppo_lag", {"trunk": "shared"}), ("cpo", {}), ("trpo_lag", {}), ("focops", {})]


@pytest.mark.parametrize("name, options", [*ON_POLICY, ("ppo_simmer_pid", {})])
def test_an_on_policy_update_keeps_the_structure(name, options):
    algo, cfg = ALGOS[name].make(Patch()), ALGOS[name].config(**TINY, encoder="cnn", **options)
    before = jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, START))
    after, _ = jax.eval_shape(algo.update, before, START)
    chex.assert_trees_all_equal_shapes_and_dtypes(before, after)
    assert before.normaliser.mean.shape == (1,)  # of the vector


def test_bc_imitates_from_pictures_of_a_file(tmp_path):
    states = jax.jit(jax.vmap(Patch().reset))(jax.random.split(jax.random.key(0), 256))
    action = 0.4 * jnp.argmax(states.obs["vision"][:, 3, :, 1] > 200, 1) - 1.2
    nothing, path = np.zeros(256, np.float32), tmp_path / "data.npz"
    obs, target = jax.device_get((states.obs, action[:, None]))
    made = data_set(obs, target, nothing, nothing, obs, nothing, nothing, {"red": nothing})
    write_dataset(path, made)
    data = read_dataset(str(path))
    chex.assert_trees_all_equal(data, made)
    cfg = ALGOS["bc"].config(updates=150, batch_size=64, hidden=(32,), lr=1e-3, encoder="cnn")
    algo, shared = ALGOS["bc"].make(Patch()), Shared(np.int32(0), data=data)
    ts, _ = jax.jit(lambda key: algo.update(algo.init(key, cfg, shared), shared))(jax.random.key(1))
    act = jax.jit(jax.vmap(lambda obs: algo.policy.act(algo.learned(ts), (), obs, None)[0]))
    assert jnp.abs(act(states.obs)[:, 0] - action).mean() < 0.1
    with pytest.raises(ConfigError, match="encoder=none: expected cnn"):
        algo.init(jax.random.key(0), dataclasses.replace(cfg, encoder="none"), shared)
    blind = data._replace(obs=data.obs["vector"], next_obs=data.obs["vector"])
    with pytest.raises(ConfigError, match="it has no pictures, the environment pictures of 8 x 8 x 3"):
        algo.init(jax.random.key(0), cfg, Shared(np.int32(0), data=blind))


def test_ppo_learns_where_the_patch_is():
    algo = ALGOS["ppo_lag"].make(Patch())
    options = {"hidden": (32,), "trunk": "shared", "lr": 2e-3, "epochs": 4, "cost_limit": 5.0}
    cfg = ALGOS["ppo_lag"].config(num_envs=64, horizon=10, minibatches=4, encoder="cnn", **options)
    ts = jax.jit(lambda: algo.init(jax.random.key(0), cfg, START))()
    update = jax.jit(algo.update)  # quick to run: convolutions are slow where little is optimised
    for _ in range(24):
        ts, metrics = update(ts, START)
    assert metrics["train/return"] > 3 and metrics["train/nonfinite"] == 0


@pytest.mark.parametrize("name", ["sac_lag", pytest.param("td3_lag", marks=pytest.mark.slow)])
def test_an_actor_critic_learns_where_the_patch_is_and_only_the_critics_teach_its_eyes(name):
    algo, cfg = ALGOS[name].make(Patch()), ALGOS[name].config(**REPLAY, cost_limit=5.0)
    first = jax.jit(lambda: algo.init(jax.random.key(0), cfg, START))()
    assert first.replay.obs["vision"].dtype == jnp.uint8
    update = jax.jit(algo.update)
    blind = dataclasses.replace(first.config, critic_lr=jnp.float32(0))
    ts = dataclasses.replace(first, config=blind)
    for iteration in range(2):
        ts, _ = update(ts, Shared(np.int32(iteration)))
    chex.assert_trees_all_equal(ts.params["encoder"], first.params["encoder"])
    moved = jax.tree.map(lambda a, b: (a != b).any(), ts.params["actor"], first.params["actor"])
    assert any(jax.tree.leaves(moved))
    ts = first
    for iteration in range(8):
        ts, metrics = update(ts, Shared(np.int32(iteration)))
    assert metrics["train/return"] > 3 and metrics["train/nonfinite"] == 0
