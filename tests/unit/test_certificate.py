"""Barrier certificates, by hand on a line and in full on the true pendulum."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import BUSY

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.learn import certificate
from jaxsafe.learn.certificate import (
    Box,
    Core,
    Search,
    System,
    certify,
    guarded,
    interval_barrier,
    walk,
)

SIZES = {
    "barrier_hidden": (32, 32),
    "barrier_lr": 3e-3,
    "barrier_decay": 1e-4,
    "margin": 0.01,
    "chains": 100,
    "temperature": 0.03,
    "barrier_steps": 2500,
    "quiet_steps": 100,
    "check_steps": 400,
}


def config(**settings):
    return SimpleNamespace(**SIZES | settings)


def test_a_barrier_of_an_interval_is_0_in_the_middle_1_at_the_ends_and_steep_beyond():
    found = interval_barrier(jnp.array([0.0, 1.0, -1.0, 2.0, -2.0, 2.2]), 2.0)
    half = -math.log(1.51 * 0.51 / 1.01**2) / -math.log(0.01 * 2.01 / 1.01**2)
    np.testing.assert_allclose(found, [0, half, half, 1, 1, 1 + 0.1 * 2 / 0.0201], rtol=1e-5, atol=1e-6)
    slopes = jax.vmap(jax.grad(lambda x: interval_barrier(x, 2.0)))(jnp.array([0.5, 1.9, 2.1, 9.0]))
    assert (slopes > 0).all()


# ---- a line: s' = g s + a, with two models of g ------------------------------------------------

BOUND = 1 - math.log(2)  # of C, where f is 0 and B is |s|


def line(gains=(1.0, 1.2)):
    """a = -k s, where k is the 'actor'."""
    return System(
        safe=lambda obs: jnp.abs(obs[..., 0]),
        start=jnp.zeros(1),
        act=lambda k, obs, cfg: -k * obs,
        foresee=lambda model, obs, action, cfg: jnp.stack([g * obs + action for g in gains]),
    )


def at_zero(k, cfg):
    """A core whose f is 0 everywhere."""
    net = certificate.init_barrier(jax.random.key(0), 1, cfg)
    return Core(jax.tree.map(jnp.zeros_like, net), jnp.float32(k), ())


def test_h_u_and_the_violations_of_a_line_are_those_by_hand():
    cfg, system = config(), line()
    s = jnp.array([[0.0], [0.2], [-0.25], [0.3], [0.31], [-0.8]])
    h, u = system.judge(at_zero(0.0, cfg), s, cfg)
    np.testing.assert_allclose(h, np.abs(s[:, 0]) - BOUND, atol=1e-6)
    np.testing.assert_allclose(u, 1.2 * np.abs(s[:, 0]) - BOUND + 0.01, atol=1e-6)
    # h < 0 where |s| < 0.307, and u + 0.01 > 0 where |s| > 0.247
    assert certificate.violating(h, u).tolist() == [False, False, True, True, False, False]
    assert not certificate.violating(*system.judge(at_zero(0.7, cfg), s, cfg)).any()  # 1.2 - 0.7 < 1


def test_the_loss_of_f_is_the_mean_of_u_less_lam_h_over_the_violations():
    """lam = 1.2, the ratio of the slopes."""
    cfg, core = config(), at_zero(0.0, config())
    s = jnp.array([[0.0], [-0.25], [0.3], [-0.8]])
    lower = jax.tree.map(jnp.copy, core.barrier)
    loss, counts = certificate.barrier_loss(line(), core, s, lower, 0.0, cfg)
    assert counts.tolist() == [False, True, True, False]
    violations = np.array([0.25, 0.3])
    by_hand = 1.2 * violations - BOUND + 0.01 - 1.2 * (violations - BOUND)
    np.testing.assert_allclose(loss(core.barrier), by_hand.mean(), atol=1e-6)
    kept, _ = certificate.barrier_loss(line(), core, s, lower, 1e3, cfg)
    np.testing.assert_allclose(kept(core.barrier), by_hand.mean(), atol=1e-6)  # h is h_ref still
    other = certificate.init_barrier(jax.random.key(1), 1, cfg)
    kept, _ = certificate.barrier_loss(line(), core, s, other, 10.0, cfg)
    risen = np.maximum(0, line().h(core.barrier, s, cfg) - line().h(other, s, cfg))
    assert risen.any()
    np.testing.assert_allclose(kept(core.barrier), by_hand.mean() + 10 * risen.mean(), rtol=1e-5)


def test_the_certified_policy_takes_over_exactly_where_no_candidate_is_allowed():
    cfg, system = config(), line()
    core = at_zero(0.7, cfg)
    rng = np.random.default_rng(0)
    s = jnp.asarray(rng.uniform(-1.2, 1.2, (300, 1)), jnp.float32)
    tried = jnp.asarray(rng.uniform(-1, 1, (4, 300, 1)), jnp.float32)
    action, overruled = guarded(system, core, s, tried, cfg)
    worst = np.maximum(np.abs(s + tried), np.abs(1.2 * s + tried))[..., 0] - BOUND
    for i in range(300):
        allowed = [k for k in range(4) if worst[k, i] <= 0]
        expected = tried[allowed[0], i] if allowed else -0.7 * s[i]
        assert bool(overruled[i]) == (not allowed)
        np.testing.assert_allclose(action[i], expected, rtol=1e-6)
    assert 30 < overruled.sum() < 270


@pytest.mark.parametrize("gain", [0.0, 1.2])
def test_walks_visit_states_as_often_as_their_density_says(gain):
    """In proportion to exp(r |s|), |s| < b, r = gain / temperature: E|s| = b / (1 - e^(-r b)) - 1 / r.
    Half of them begin outside of C."""
    cfg, system = config(chains=2000, temperature=0.15, barrier_hidden=(2,)), line((gain,))
    z = jnp.linspace(-2 * BOUND, 2 * BOUND, 2000)[:, None]
    start = Search(
        z, jnp.full(2000, 0.01), Box(jnp.zeros(1), jnp.ones(1)), jax.random.key_data(jax.random.key(0))
    )
    core = at_zero(0.0, cfg)

    def step(search, _):
        return walk(system, core, search, cfg), jnp.abs(search.obs).mean()

    run = jax.jit(lambda start: jax.lax.scan(step, start, None, 1500), compiler_options=BUSY)
    end, seen = run(start)
    assert (jnp.abs(end.obs) < BOUND).all()
    r = gain / 0.15
    expected = BOUND / (1 - math.exp(-r * BOUND)) - 1 / r if gain else BOUND / 2
    np.testing.assert_allclose(seen[500:].mean(), expected, rtol=0.02)


# ---- the true pendulum -------------------------------------------------------------------------


def pendulum():
    """pi(s) = clip(-k s), with k the 'actor'; the only model is the pendulum itself."""
    env = envs.make("pendulum_upright")
    state = env.reset(jax.random.key(0))

    def foresee(model, obs, action, cfg):
        flat, actions = obs.reshape(-1, 2), action.reshape(-1, 1)
        after = jax.vmap(lambda s, a: env.step(state.replace(physics=s), a).obs)(flat, actions)
        return after.reshape(1, *obs.shape)

    def act(k, obs, cfg):
        return jnp.clip(-(obs @ k)[..., None], -1.0, 1.0)

    return env, System(env.barrier, state.obs, act, foresee)


def searches():
    """k -> what comes of the search for a certificate of pi."""
    cfg, (_, system) = config(), pendulum()

    def run(k):
        net = certificate.init_barrier(jax.random.key(0), 2, cfg)
        search = certificate.begun(system, net, jax.random.key(1), cfg)
        state = certificate.decayed_adam(0.0, 0.0).init(net)
        return certify(system, Core(net, k, ()), net, 0.0, state, search, cfg)

    return jax.jit(run, compiler_options=BUSY)


BALANCE, LIMP = jnp.array([6.0, 1.5]), jnp.zeros(2)


def test_a_certified_region_is_never_left_on_the_true_pendulum():
    """Neither by pi, which a fine grid shows, nor by what the certificate allows at random."""
    cfg, (env, system) = config(), pendulum()
    search = searches()
    found = search(BALANCE)
    assert found.certified and not found.at_once
    assert not search(LIMP).certified  # without a push it falls from s_0, which is in C
    core = Core(found.barrier, BALANCE, ())
    angle, velocity = np.meshgrid(np.linspace(-1.6, 1.6, 201), np.linspace(-8, 8, 401))
    grid = jnp.asarray(np.stack([angle, velocity], -1), jnp.float32).reshape(-1, 2)
    h, u = system.judge(core, grid, cfg)
    inside = np.asarray(h < 0)
    assert (np.asarray(u)[inside] <= 0).all() and (np.abs(grid[inside, 0]) < env.threshold).all()
    assert 0.5 < inside.mean() * 3.2 * 16 < 5  # neither a point nor all that is safe

    def step(state, key):
        tried = jax.random.uniform(key, (5, 64, 1), minval=-1.0, maxval=1.0)
        action, overruled = guarded(system, core, state.obs, tried, cfg)
        after = jax.vmap(env.step)(state, action)
        return after, (after.cost, system.h(core.barrier, after.obs, cfg), overruled)

    begin = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 64))
    run = jax.jit(lambda keys: jax.lax.scan(step, begin, keys)[1], compiler_options=BUSY)
    cost, height, overruled = run(jax.random.split(jax.random.key(1), 300))
    assert (cost == 0).all() and (height < 0).all()
    assert 0.001 < overruled.mean() < 0.9


FRESH = 100.0  # where `scripted_search` begins anew


def scripted_search(monkeypatch, violations):
    """What `certify` comes to where a walk counts its steps, where it begins anew from FRESH, 2 FRESH,
    ... on, and those in `violations` find one. Each violation adds 1 to f."""

    def counted(system, core, search, cfg):
        return dataclasses.replace(search, z=search.z + 1)

    def anew(system, barrier, key, cfg):
        count = jax.random.key_data(key)[0] + 1
        return Search(jnp.full((1, 1), count * FRESH), jnp.zeros(1), BOX, jnp.array([count, 0]))

    def scripted(system, core, obs, reference, keep, cfg):
        return lambda barrier: -barrier, jnp.isin(obs[:, 0], jnp.array(violations))

    ascent = SimpleNamespace(update=lambda slope, state, net: (-slope, state))
    for name, value in {"walk": counted, "begun": anew, "barrier_loss": scripted}.items():
        monkeypatch.setattr(certificate, name, value)
    monkeypatch.setattr(certificate, "decayed_adam", lambda *_: ascent)
    begin = Search(jnp.zeros((1, 1)), jnp.zeros(1), BOX, jnp.zeros(2, jnp.uint32))
    cfg = config(quiet_steps=3, check_steps=2, barrier_steps=30)
    return certify(line(), Core(jnp.float32(0), (), ()), (), 0.0, (), begin, cfg)


BOX = Box(jnp.zeros(1), jnp.ones(1))
# It is quiet for 3 steps and then needs 2 of a search that began anew.
CLOCK = [
    ([], 3 + 2, 100, True),
    ([1.0, 2.0], 2 + 3 + 2, 100, True),
    ([3.0], 3 + 3 + 2, 100, True),
    ([FRESH + 2], 3 + 2 + 3 + 2, 200, True),  # what is quiet need not be so anew
    ([n * FRESH + 1 for n in range(1, 9)], 30, 700, False),
]


@pytest.mark.parametrize("violations, steps, begun, certified", CLOCK)
def test_a_certificate_is_quiet_and_then_passes_a_search_that_begins_anew(
    monkeypatch, violations, steps, begun, certified
):
    found = scripted_search(monkeypatch, violations)
    assert (found.certified, found.at_once) == (certified, not violations)
    assert found.steps == steps and found.search.z[0, 0] // FRESH * FRESH == begun
    assert found.barrier == len([x for x in violations if x < begun + FRESH])  # each moved f, no more


def test_an_environment_without_a_safe_set_is_refused():
    with pytest.raises(ConfigError, match=r"by a method `barrier\(obs\)`; env=pendulum_upright does"):
        certificate.safe_set(envs.make("car_racing0"))
