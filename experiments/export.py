"""Export policies to play them without this code: ONNX, plain NumPy or JAX, with a contract of what goes in and out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from envs.types import UserError
from experiments.runner import cli
from experiments.runner.options import prior_folders, task_of_priors
from experiments.runner.progress import doing
from sgft_jax.io.runs import check_folder


@dataclass(frozen=True)
class ExportArgs:
    """One export of each policy, played once on random observations and compared with the policy."""

    policy: Path
    """Folder of a policy or a prior, or of a run with several; RUN/best has those that did best in real rollouts."""
    to: Literal["onnx", "jax", "numpy"]
    """numpy: plays with NumPy alone. onnx: with onnxruntime. jax: with JAX, and the only one for policies that plan."""
    out: Path | None = None
    """Where to write; of a run, each policy into a folder called like its own, such as seed-0. Default: export/<to>
    inside --policy."""
    task: str | None = None
    """A Python file with a task of your own; default: the task of the policy."""


def main(args: ExportArgs) -> None:
    """Writes the exports and says where they are and how exact."""
    folders = prior_folders(args.policy, out=Path(), task="", preset="", option="--policy")
    task = task_of_priors(folders, args.task)
    home = args.out or args.policy / "export" / args.to
    check_folder(home)
    homes = [home if folder == args.policy else home / folder.name for folder in folders]
    if existing := [path for path in homes if path.exists()]:
        raise UserError(f"{existing[0]}: exists already; choose another --out, or remove it")
    import envs
    from sgft_jax.export.exported import save_exported
    from sgft_jax.io.priors import load_prior, variant_of

    for folder, path in zip(folders, homes, strict=True):
        env = envs.make(task, **variant_of([folder]))
        prior = load_prior(folder, task=env.name, obs_dim=env.obs_dim, act_dim=env.act_dim)
        with doing(f"exporting to {args.to} and comparing actions"):
            worst = save_exported(path, prior, env, args.to)
        print(f"{path}: actions differ from the policy's by {worst:.1e} at most")


if __name__ == "__main__":
    cli.run_main(main, ExportArgs, __doc__ or "")
