"""`convert`: recordings and demonstrations in the formats of other projects."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Turn recordings of `deploy`, or demonstrations, into a data set for LeRobot (LeRobotDataset v3.0).

    Each recording becomes an episode with a frame for each look; each demonstration becomes one with a frame for each
    move. Images stay as they are: colours as PNG, depth as 16 bits in millimetres. Needs the extra `lerobot`.
    """

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE ...")]
    """Recordings (run.mcap) or files of demonstrations (trajectory.h5), in the order of the episodes."""
    to: Literal["lerobot"] = "lerobot"
    """The format."""
    out: Path
    """The new folder."""
    task: str | None = None
    """What was to be done, in words; by default what the files say."""
    fps: int = 1
    """Frames a second in the data set's time stamps. Looks have no fixed rate; a run's feature `seconds` holds when
    each was."""

    depth: bool = True
    """Write images of depth. Policies of LeRobot whose networks take three channels, such as ACT, cannot read them."""

    def run(self) -> None:
        """Converts and says what there is."""
        from maniskill_tomato.conversion.lerobot_conversion import check_sources, convert_to_lerobot

        check_sources(self.sources)

        from tqdm import tqdm

        with tqdm(unit="episode", disable=None) as bar:
            done = convert_to_lerobot(
                self.sources, self.out, fps=self.fps, task=self.task, depth=self.depth, on_episode=bar.update
            )
        print(f"{self.out}: {done.episodes} episodes, {done.frames} frames")
        print(f"features  {', '.join(done.features)}")
