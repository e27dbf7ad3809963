"""Which clock ends a run, and which one is shown."""

import pytest

from jaxsafe.config import ConfigError
from jaxsafe.run import clock
from jaxsafe.run.checkpoint import Progress
from jaxsafe.run.settings import TrainConfig
from jaxsafe.types import Clocks

BOTH, OFFLINE = Clocks(64, 4), Clocks(0, 10)


@pytest.mark.parametrize(
    "options, clocks, iterations",
    [
        ({"total_steps": 640}, BOTH, 10),
        ({"total_steps": 641}, BOTH, 11),
        ({"total_steps": 640, "total_updates": 12}, BOTH, 3),
        ({"total_steps": 1, "total_updates": 13}, BOTH, 4),
        ({"total_updates": 95}, OFFLINE, 10),
    ],
)
def test_gradient_steps_end_a_run_where_they_are_given_and_else_environment_steps(
    options, clocks, iterations
):
    train = TrainConfig(**options)
    assert clock.iterations(train, clocks) == iterations
    assert clock.ended(train, clock.after(iterations, clocks))
    assert not clock.ended(train, clock.after(iterations - 1, clocks))


def test_a_clock_that_stands_still_ends_no_run():
    with pytest.raises(ConfigError, match="total_steps=64: the algorithm takes no environment steps"):
        clock.iterations(TrainConfig(total_steps=64), OFFLINE)
    with pytest.raises(ConfigError, match="total_updates=64: the algorithm takes no gradient steps"):
        clock.iterations(TrainConfig(total_updates=64), Clocks(64, 0))


def test_a_multiple_is_crossed_once_by_whole_iterations():
    crossed = [i for i in range(1, 8) if clock.unit(BOTH).crosses(100, i)]
    assert crossed == [2, 4, 5, 7]  # 128, 256, 320 and 448 are the first from 100, 200, 300, 400 on
    assert [i for i in range(1, 4) if clock.unit(OFFLINE).crosses(10, i)] == [1, 2, 3]
    assert not any(clock.unit(BOTH).crosses(0, i) for i in range(1, 8))


def test_environment_steps_are_shown_where_there_are_any():
    assert clock.unit(BOTH) == ("steps", 64) and clock.unit(BOTH).at(3) == 192
    assert clock.unit(OFFLINE) == ("updates", 10)
    assert clock.after(3, OFFLINE) == Progress(iteration=3, steps=0, updates=30)
