"""How simulator steps and updates alternate. Imports no JAX: command lines read it."""

from dataclasses import dataclass

from sgft_jax import checks


@dataclass(frozen=True)
class Schedule(checks.Checked):
    """How simulator steps and updates alternate."""

    updates: checks.Count = 1_000_000
    """Gradient updates in all."""
    simulators: checks.Count = 25
    """Simulators of a run that are stepped together. The released code has one."""
    steps_per_round: checks.Count = 1
    """Steps of every simulator before updates follow. The released code makes 1,000 of its one simulator."""
    updates_per_step: checks.Positive = 1.0
    """Updates for each step of one simulator."""
    buffer: checks.Count = 1_000_000
    """Simulated transitions kept; new ones replace the oldest."""
    chunk_updates: checks.Count = 5_000
    """Updates of a compiled chunk, at most all of them, rounded to whole rounds; logs, evaluations and checkpoints come
    between chunks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rows_per_round > self.buffer:
            raise checks.refusal("buffer", self.buffer, f"at least the rows of a round, {self.rows_per_round}")

    @property
    def rows_per_round(self) -> int:
        """Simulated transitions of a round."""
        return self.simulators * self.steps_per_round

    @property
    def updates_per_round(self) -> int:
        """Updates of a round."""
        return max(round(self.rows_per_round * self.updates_per_step), 1)

    @property
    def rounds_per_chunk(self) -> int:
        """Rounds of a chunk."""
        return max(round(min(self.chunk_updates, self.updates) / self.updates_per_round), 1)

    @property
    def updates_per_chunk(self) -> int:
        """Updates of a chunk."""
        return self.rounds_per_chunk * self.updates_per_round

    @property
    def chunks(self) -> int:
        """Chunks of the whole run; the last one is whole too."""
        return max(-(-self.updates // self.updates_per_chunk), 1)

    @property
    def updates_in_all(self) -> int:
        """Updates of the whole run, those of the last chunk too."""
        return self.chunks * self.updates_per_chunk


FLEET = "fleet"  # the default
SCHEDULES = {FLEET: Schedule(), "released": Schedule(simulators=1, steps_per_round=1_000)}  # ours; H2O+'s code's


def name_of(schedule: Schedule) -> str:
    """What `SCHEDULES` calls this rhythm of steps and updates, however many there are; "custom" for any other."""
    return next((name for name, known in SCHEDULES.items() if _rhythm(known) == _rhythm(schedule)), "custom")


def describe(schedule: Schedule) -> str:
    """The rhythm and the number of updates in words, for what shows scores."""
    return (
        f"{schedule.updates_in_all:,} updates, schedule {name_of(schedule)} (simulators: {schedule.simulators:,}; "
        f"steps of each per round: {schedule.steps_per_round:,}; updates per round: {schedule.updates_per_round:,})"
    )


def _rhythm(schedule: Schedule) -> tuple[float, ...]:
    return (schedule.simulators, schedule.steps_per_round, schedule.updates_per_step)
