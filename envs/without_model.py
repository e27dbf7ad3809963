"""What environments without a MuJoCo model share. Such an environment is a dataclass of its options."""

from jaxsafe.config import check_values


class WithoutModel:
    """Options, one of which is the time limit. A subclass adds the sizes and names of an `Env`."""

    num_steps: int

    def __post_init__(self) -> None:
        check_values(self, "env.")

    @property
    def episode_length(self) -> int:
        return self.num_steps
