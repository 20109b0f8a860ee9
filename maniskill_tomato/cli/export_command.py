"""`maniskill-tomato export`: policies that run without PyTorch."""

from dataclasses import dataclass
from pathlib import Path

from maniskill_tomato.cli.early_checks import check_file
from maniskill_tomato.policies.opening import shipped_policy
from maniskill_tomato.tasks import THESIS_IDS


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a policy as an ONNX file and a JSON description, which run without PyTorch and ManiSkill."""

    policy: Path | None = None
    """File of the policy, or a checkpoint of its run; by default those that ship with the package."""
    out: Path = Path("runs/export")
    """Folder of the results; an earlier export of the same name in it is replaced."""

    def run(self) -> None:
        """Exports and says where the files are."""
        check_file("--policy", self.policy)

        from maniskill_tomato.learning.rl.export import export_policy

        for path in [self.policy] if self.policy else [shipped_policy(env_id) for env_id in THESIS_IDS]:
            result = export_policy(path, self.out)
            print(f"model       {result.model}")
            print(f"description {result.description}")
            print(f"largest difference from PyTorch {result.largest_difference:.1e}")
