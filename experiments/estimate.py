"""Give priors an estimator: a network that says which systems may have made real rollouts, for method `posterior`.

It learns in simulation alone: systems are drawn from what a real one may be, and the priors' policies play ten rollouts
in each, on a GPU one in 22 of them in MuJoCo's own engine. Priors that play one task share what is learned. Ten to
twenty minutes on a GPU.
"""

from dataclasses import dataclass
from pathlib import Path

from envs import extend
from envs.types import UserError
from experiments.runner import cli
from experiments.runner.options import Impl, at_least_one, check_prior, prior_folders, task_of_priors
from experiments.runner.progress import doing
from sgft_jax.io.cards import resolve_shipped


@dataclass(frozen=True)
class EstimateArgs:
    """One estimator."""

    prior: Path
    """Folder of a prior, or of several (prior/seed-*), which are written anew with it."""
    lessons: int = 67_584
    """Simulated systems to learn from, ten rollouts each."""
    updates: int = 2500
    """Updates for each number of rollouts that are read together: one, two, four and ten."""
    start: Path | None = None
    """Prior of the task whose estimator goes on learning, such as shipped:push/seed-0: the way without a GPU, with
    --lessons 4000 --updates 100 in 36 minutes on two cores (docs/methods.md)."""
    task: str | None = None
    """A Python file with a task of your own; default: the task of the prior."""
    impl: Impl = "auto"


def main(args: EstimateArgs) -> None:
    """Writes the priors and says how well the estimator tells systems apart that it has not learned from."""
    at_least_one(args, "lessons", "updates")
    folders = prior_folders(args.prior, out=Path(), task="", preset="")
    if str(args.prior).startswith("shipped:"):
        raise UserError(f"--prior {args.prior}: comes with the code; copy {resolve_shipped(args.prior)} and name that")
    task = task_of_priors(folders, args.task)
    from sgft_jax.methods import get_method

    for folder in folders:
        check_prior(folder, get_method("posterior"), extend.name_of(task))
    import envs
    from envs.mujoco.worlds import choose_impl
    from experiments.runner.estimating import Simulator, learned
    from sgft_jax.io.priors import load_prior, load_priors, save_prior, variant_of
    from sgft_jax.models.config import network_of
    from sgft_jax.policies import sac_policy
    from sgft_jax.posterior.candidates import candidates
    from sgft_jax.posterior.interface import entry_of
    from sgft_jax.types import Prior

    engines = dict.fromkeys((choose_impl(args.impl), "c"))
    made = [envs.make(task, engine, **variant_of(folders)) for engine in engines]
    env = made[0]
    priors, entry = load_priors(folders, env), entry_of(env)
    former = args.start and load_prior(args.start)
    if former and former.card.get("estimator") != entry:
        raise UserError(f"--start {args.start}: has no estimator of the systems of {env.name}")
    policy = sac_policy(env.obs_dim, env.act_dim, network_of(priors[0].card))
    with doing(f"compiling the simulator and worlds of {env.name}", 40, once=True):
        env.prepare()
        simulators = [Simulator(env, candidates(env)) for env in made]
    params = [prior.params for prior in priors]
    estimator, gained = learned(
        simulators,
        policy,
        params,
        lessons=args.lessons,
        updates=args.updates,
        former=former and former.params.estimator,
    )
    for folder, prior in zip(folders, priors, strict=True):
        card = {**prior.card, "estimator": entry}
        print(save_prior(folder, Prior(prior.params._replace(estimator=estimator), card)))
    for number, nats in gained.items():
        print(f"after {number} rollouts it is {nats:.1f} nats surer of a system than before any")


if __name__ == "__main__":
    cli.run_main(main, EstimateArgs, __doc__ or "")
