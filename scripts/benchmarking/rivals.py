"""Everything that is measured beside other libraries, and its tables."""

from pathlib import Path
from typing import Any, Final

from benchmarking.arm_solvers import compare_solvers
from benchmarking.detectors import compare_detectors
from benchmarking.ray_libraries import compare_libraries, compare_steps

TITLES: Final = {
    "inverse_kinematics": "Inverse kinematics",
    "rays": "Rays",
    "steps": "Steps with either ray library",
    "detectors": "Detectors",
}
"""Of the tables, by the key in the JSON."""


def rival_results(
    repeats: int, poses: int, envs: tuple[int, ...], photos: str | None, yolo: Path | None
) -> dict[str, list[dict[str, Any]]]:
    """Rows of all tables; libraries that are not installed are left out.

    Args:
        repeats: Turns of each rate.
        poses: That every inverse kinematics solves.
        envs: Environments at once whose steps are measured.
        photos: FOLDER:SPLIT to compare detectors on; None to leave them out.
        yolo: A YOLO in ONNX, or None.
    """
    results = {
        "inverse_kinematics": compare_solvers(poses),
        "rays": compare_libraries(repeats),
        "steps": compare_steps(envs, repeats),
    }
    if photos is not None:
        results["detectors"] = compare_detectors(photos, yolo)
    return results


def rival_tables(results: dict[str, list[dict[str, Any]]]) -> str:
    """The rows as Markdown tables, one a subject."""
    parts = []
    for key, rows in results.items():
        names = list(rows[0])
        lines = [
            "| " + " | ".join(name.replace("_", " ") for name in names) + " |",
            "|" + "---|" * len(names),
        ]
        lines += ["| " + " | ".join(_cell(row[name]) for name in names) + " |" for row in rows]
        parts.append(f"## {TITLES[key]}\n\n" + "\n".join(lines) + "\n")
    return "\n".join(parts)


def _cell(value: object) -> str:
    if isinstance(value, float) and value >= 1000.0:
        return f"{value:,.0f}"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
