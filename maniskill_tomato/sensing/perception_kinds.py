"""The words for how a robot sees, what it observes, and how it is told its target; free of anything that is slow to
import."""

from typing import Final, Literal

Perception = Literal[
    "ground_truth", "occlusion_model", "simulated_segmenter", "thesis_model", "improved_model", "segmenter"
]
"""What reward, observation and the target's position come from.

`occlusion_model`: `SphereModel` on a perfect mask and noisy depth. `simulated_segmenter`: the same on masks with the
light segmenter's errors (`sensing.simulated_segmenter`), of fruits of every ripeness. `thesis_model`,
`improved_model`: those models on perfect masks and rendered colours. `segmenter`: the light segmenter's masks in
rendered colours, then `SphereModel`."""

RENDERED: Final[tuple[Perception, ...]] = ("thesis_model", "improved_model", "segmenter")
"""Those that need colours, and so a renderer."""

Naming = Literal["track", "map", "any"]
"""How a robot that sees through a camera is told its target.

`track`: the episode's target is fixed beforehand; the robot moves until it has a track that holds most of the target's
visible pixels, and that track is named to it. `map`: a place is given, with an error. `any`: the robot chooses a ripe
fruit that it does not see fully yet."""

Association = Literal["map", "truth"]
"""Who says which track a detection belongs to: the fruit map, or the simulator."""

MAP_NOISE: Final = 0.03
"""Standard deviation of each coordinate of a place that a map of the row gives, in [m]."""

Part = Literal["viewpoint", "pose", "target", "visible_fraction", "time", "patch", "map", "near_map"]
"""Parts of the general tasks' observation; see `sensing.observation.ObservationLayout`."""

ImageKind = Literal["rgb", "depth", "segmentation"]
"""What an image of an observation tells of every pixel; see `sensing.image_layout.ImageLayout`."""

STATE_MODE: Final = "state"
"""The observation mode without images."""
