"""Whether a set that was made anew may stand for one of D4RL's. Pure.

The published numbers are those of D4RL's v2 files of HalfCheetah and Walker2d (Fu et al. 2020). Mean returns of the two
`medium-replay` files are not among them: how much of a learner's past is poor depends on how fast it learns, so only
the number of their transitions is judged.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sgft_jax.datasets.logs import Facts

LENGTH = "mean episode length"
_MEAN, _STD, _SIZE = "mean return", "std of returns", "transitions"


class Band(NamedTuple):
    """What a number has to be: that of D4RL, give or take a share of it."""

    published: float
    share: float


class Verdict(NamedTuple):
    """A criterion of a set: its name, the value, and the bounds within which the value is accepted."""

    criterion: str
    value: float
    low: float
    high: float

    @property
    def passed(self) -> bool:
        """Whether the value is within the bounds."""
        return self.low <= self.value <= self.high

    def __str__(self) -> str:
        verdict = "pass" if self.passed else "FAIL"
        return f"{verdict}: {self.criterion} {self.value:,.0f}, accepted from {self.low:,.0f} to {self.high:,.0f}"


# A walker that never falls would walk 1,000 steps, one that falls twice as often as D4RL's 420: 15 % tells both apart.
BANDS: Mapping[str, Mapping[str, Band]] = {
    "halfcheetah-medium": {_MEAN: Band(4770.3, 0.05)},
    "halfcheetah-medium-replay": {_SIZE: Band(202_000, 0.25)},
    "walker2d-medium": {_MEAN: Band(2852.1, 0.05), _STD: Band(1095.0, 0.25), LENGTH: Band(840.0, 0.15)},
    "walker2d-medium-replay": {_SIZE: Band(302_000, 0.25)},
}


def judge(name: str, facts: Facts, *, mean_length: float) -> Sequence[Verdict]:
    """A verdict for each criterion of the set `TASK-KIND`; none for a set that D4RL does not have.

    facts: of the file. mean_length: steps of an episode on average.
    """
    values = {_MEAN: facts.return_mean, _STD: facts.return_std, _SIZE: facts.transitions, LENGTH: mean_length}
    return [
        Verdict(criterion, float(values[criterion]), published * (1 - share), published * (1 + share))
        for criterion, (published, share) in BANDS.get(name, {}).items()
    ]
