"""The replay against plain lists of episodes."""

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.learn.replay import (
    Index,
    Record,
    Span,
    draw,
    empty_ring,
    held,
    ring_rows,
    sequences,
    take,
    transitions,
    write,
)

DISCOUNT, COST_DISCOUNT = 0.9, 0.5


def life(rng, length, mean_steps):
    """`length` rows of one environment as dicts. Rewards and costs are all different."""
    rows = []
    while len(rows) < length:
        steps, terminates = rng.integers(1, 2 * mean_steps + 1), rng.random() < 0.5
        for step in range(steps + 1):
            rows.append(
                {
                    "name": len(rows),
                    "episode": sum(row["first"] for row in rows) + (step == 0),
                    "first": step == 0,
                    "terminated": bool(step == steps and terminates),
                    "truncated": bool(step == steps and not terminates),
                    "reward": rng.normal() if step else 0.0,
                    "cost": rng.normal() if step else 0.0,
                    "action": rng.normal(),
                }
            )
    return rows[:length]


def as_rows(lives, begin, end):
    """Rows begin .. end - 1 of all environments, [T, N, ...]."""

    def field(name, dtype: Any = np.float32) -> Any:
        return np.array([[life[t][name] for life in lives] for t in range(begin, end)], dtype)

    names, envs = field("name"), np.arange(len(lives))
    pixels = np.stack([names % 256, names // 256, names + envs], -1) % 256
    make: Any = Record  # of NumPy's arrays
    return make(
        obs={"vector": np.stack([names, field("episode")], -1), "pixels": pixels.astype(np.uint8)},
        action=field("action")[..., None],
        reward=field("reward"),
        cost=field("cost"),
        costs=np.stack([field("cost"), -field("cost")], -1),
        first=field("first", bool),
        terminated=field("terminated", bool),
        truncated=field("truncated", bool),
    )


ROWS, ENVS = 12, 2  # of every ring here, so that they share their programs
CASES = {  # rows an iteration, rows a write, since, until, mean steps of an episode
    "not yet full": (4, 4, 0, 2, 2),
    "just full": (4, 2, 0, 3, 3),
    "wrapped once": (4, 1, 0, 4, 1),
    "wrapped many times": (3, 3, 0, 17, 4),
    "resumed without its replay": (3, 3, 7, 9, 2),
    "resumed and wrapped": (3, 1, 5, 14, 6),
    "one iteration fills it": (12, 6, 2, 5, 1),
    "episodes longer than the ring": (4, 4, 0, 9, 40),
}
PUT = jax.jit(write)
AHEAD = jax.jit(
    lambda ring, span, index, n_step: transitions(
        ring, span, index, discount=DISCOUNT, cost_discount=COST_DISCOUNT, n_step=n_step
    ),
    static_argnums=3,
)
ALONG = jax.jit(sequences, static_argnums=3)
# every row that a full ring has; those of a ring that is not full come first
EVERYWHERE = Index(*(jnp.int32(x.ravel()) for x in np.indices((ROWS, ENVS))))


@cache
def case(name):
    """Lives of rows, a ring filled with them, its span, and the oldest row of the lives in it."""
    block, chunk, since, until, steps = CASES[name]
    rng = np.random.default_rng(len(name))
    lives = [life(rng, (until - since) * block, steps) for _ in range(ENVS)]
    ring, written = empty_ring(jax.tree.map(lambda x: x[0], as_rows(lives, 0, 1)), ROWS), 0
    for iteration in range(since, until):
        for done in range(0, block, chunk):
            clock = np.int32(iteration), np.int32(since)
            new = as_rows(lives, written, written + chunk)
            ring = PUT(ring, new, held(ROWS, block, np.int32(done), *clock))
            written += chunk
            span = held(ROWS, block, np.int32(done + chunk), *clock)
    assert span.count == min(written, ROWS)
    return lives, ring, span, written - int(span.count)


def rows_of(case, ahead):
    """(b, position, rows of its environment in the ring, environment) of all that `draw` may give."""
    lives, _, span, oldest = case
    for b, (position, env) in enumerate(zip(*map(np.asarray, EVERYWHERE), strict=True)):
        if position < span.count - ahead:
            yield b, position, lives[env][oldest : oldest + int(span.count)], env


@pytest.mark.parametrize("name", CASES)
def test_the_ring_holds_the_newest_rows_in_their_order(name):
    lives, ring, span, oldest = case(name)
    kept, count = take(ring, span, EVERYWHERE), int(span.count)
    expected = as_rows(lives, oldest, oldest + count)
    for x, y in zip(jax.tree.leaves(kept), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(x[: count * ENVS], y.reshape(-1, *y.shape[2:]))
        assert x.dtype == y.dtype


def follow(rows, t, n_step):
    """Reward, cost, steps and the row at the end of the transition that begins with rows[t]."""
    reward = cost = steps = 0
    while steps < n_step and t + 1 < len(rows) and not (rows[t]["terminated"] or rows[t]["truncated"]):
        t += 1
        reward += DISCOUNT**steps * rows[t]["reward"]
        cost += COST_DISCOUNT**steps * rows[t]["cost"]
        steps += 1
    return reward, cost, steps, rows[t]


@pytest.mark.parametrize("n_step", [1, 3, 5, 20])
@pytest.mark.parametrize("name", CASES)
def test_transitions_are_those_of_the_episodes(name, n_step):
    got = jax.tree.map(np.asarray, AHEAD(*case(name)[1:3], EVERYWHERE, n_step))
    for b, position, rows, env in rows_of(case(name), ahead=1):
        reward, cost, steps, end = follow(rows, position, n_step)
        is_last = rows[position]["terminated"] or rows[position]["truncated"]
        assert got.weight[b] == (not is_last) and got.steps[b] == steps
        assert got.obs["vector"][b, 0] == rows[position]["name"]
        if is_last:
            continue
        close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)
        close(got.reward[b], reward)
        close(got.cost[b], cost)
        close(got.costs[b], [cost, -cost])
        close(got.action[b], [rows[position]["action"]])
        assert got.terminated[b] == end["terminated"]
        row = rows[position + steps]["name"]
        assert got.next_obs["vector"][b].tolist() == [row, rows[position]["episode"]]
        assert got.next_obs["pixels"][b].tolist() == [row % 256, row // 256, (row + env) % 256]
    assert got.obs["pixels"].dtype == np.uint8


@pytest.mark.parametrize("length", [1, 7, 30])
@pytest.mark.parametrize("name", CASES)
def test_sequences_are_rows_in_order_and_mark_where_a_memory_begins(name, length):
    got = jax.tree.map(np.asarray, ALONG(*case(name)[1:3], EVERYWHERE, length))
    count = int(case(name)[2].count)
    seen = np.zeros((count, ENVS), int)
    for b, position, rows, env in rows_of(case(name), ahead=0):
        along = [(position + i) % count for i in range(length)]
        assert got.obs["vector"][:, b, 0].tolist() == [rows[t]["name"] for t in along]
        assert got.first[:, b].tolist() == [rows[t]["first"] or t == 0 for t in along]
        memories = np.cumsum(got.first[:, b])
        for memory in np.unique(memories):  # what a memory takes for one episode is one
            inside = {rows[t]["episode"] for t, m in zip(along, memories, strict=True) if m == memory}
            assert len(inside) == 1
        np.add.at(seen, (along, env), 1)
    assert (seen == length).all()  # each row as often as any other


def test_draws_are_uniform_over_rows_that_have_a_successor():
    lives = [life(np.random.default_rng(0), 1, 2)] * 3
    ring = empty_ring(jax.tree.map(lambda x: x[0], as_rows(lives, 0, 1)), 8)
    index = draw(jax.random.key(0), ring, Span(jnp.int32(5), jnp.int32(6)), 60_000)
    counts = np.zeros((8, 3))
    np.add.at(counts, (np.asarray(index.position), np.asarray(index.env)), 1)
    assert (counts[5:] == 0).all()  # neither the newest row nor one that is not held
    expected = 60_000 / 15
    assert ((counts[:5] - expected) ** 2 / expected).sum() < 40  # chi-square, 14 degrees of freedom
    alone = draw(jax.random.key(0), ring, Span(jnp.int32(0), jnp.int32(1)), 100)
    assert (alone.position == 0).all()


@pytest.mark.parametrize(
    "size, num_envs, block, rows",
    [(1000, 10, 10, 100), (1000, 10, 7, 98), (1040, 10, 10, 100), (1060, 10, 10, 110), (5, 10, 4, 4)],
)
def test_the_capacity_is_rounded_to_whole_blocks(size, num_envs, block, rows):
    assert ring_rows(size, num_envs, block) == rows


def test_the_clock_does_not_overflow_late_in_a_long_run():
    span = held(12, 4, 4, jnp.int32(2**31 - 2), jnp.int32(0))
    assert span.count == 12 and span.oldest == (((2**31 - 2) % 3) * 4 + 4 - 12) % 12


def test_members_write_and_sample_as_if_alone():
    lives = [[life(np.random.default_rng(10 * m + n), 20, 3) for n in range(2)] for m in range(3)]

    def one(rows, iteration):
        ring = empty_ring(jax.tree.map(lambda x: x[0], rows), 8)
        for i in range(5):
            span = held(8, 4, 0, iteration + i, jnp.int32(0))
            ring = write(ring, jax.tree.map(lambda x, i=i: x[4 * i : 4 * i + 4], rows), span)
        span = held(8, 4, 4, iteration + 4, jnp.int32(0))
        index = draw(jax.random.key(0), ring, span, 50)
        return transitions(ring, span, index, discount=0.9, cost_discount=0.9, n_step=3)

    rows = [jax.tree.map(jnp.asarray, as_rows(own, 0, 20)) for own in lives]
    together = jax.tree.map(lambda *x: jnp.stack(x), *rows)
    got = jax.jit(jax.vmap(one, in_axes=(0, None)))(together, jnp.int32(0))
    lone = jax.jit(one)
    for m in range(3):
        expected = lone(rows[m], jnp.int32(0))
        for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(x[m], y, rtol=1e-6)


@pytest.mark.parametrize("members", [None, 3])
def test_a_write_is_one_update_slice_into_the_ring_that_was_given(members):
    row = jax.tree.map(lambda x: x[0], as_rows([life(np.random.default_rng(0), 3, 2)] * 5, 0, 1))
    ring = empty_ring(row, 12)  # [5, 12, ...]
    new = jax.tree.map(lambda x: jnp.stack([x] * 4), row)  # [4, 5, ...]

    def put(ring, new, iteration):
        return write(ring, new, held(12, 4, 0, iteration, jnp.int32(0)))

    if members:
        ring, new = (jax.tree.map(lambda x: jnp.stack([x] * members), t) for t in (ring, new))
        put = jax.vmap(put, in_axes=(0, 0, None))
    compiled = jax.jit(put, donate_argnums=0).lower(ring, new, jnp.int32(0)).compile()
    text = compiled.as_text()
    assert "dynamic-update-slice(" in text and "scatter(" not in text
    copied = [line for line in text.splitlines() if " copy(" in line]
    assert not any("5,12" in line.partition(" copy(")[0] for line in copied)  # of the new rows alone
    memory = compiled.memory_analysis()
    size = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(ring))
    assert memory is not None and memory.alias_size_in_bytes == size
    assert memory.temp_size_in_bytes < size


def test_the_ring_of_one_environment_enters_and_leaves_a_loop_without_a_copy():
    row = jax.tree.map(lambda x: x[0], as_rows([life(np.random.default_rng(0), 3, 2)], 0, 1))
    ring, new = (jax.tree.map(lambda x: x[None], empty_ring(row, rows)) for rows in (4096, 1))

    def put(rings, rows):  # of one member, whose axis the loop does without
        ring, new = jax.tree.map(lambda x: x[0], (rings, rows))

        def step(ring, i):
            return write(ring, new, held(4096, 1, 0, i, jnp.int32(0))), None

        return jax.tree.map(lambda x: x[None], jax.lax.scan(step, ring, jnp.arange(3))[0])

    memory = jax.jit(put, donate_argnums=0).lower(ring, new).compile().memory_analysis()
    least = min(x.size * x.dtype.itemsize for x in jax.tree.leaves(ring))
    assert memory is not None and memory.temp_size_in_bytes < least
