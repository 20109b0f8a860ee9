"""All occlusion models by name."""

from collections.abc import Callable
from typing import Final

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.sensing.visible_fraction.amodal import AmodalModel
from maniskill_tomato.sensing.visible_fraction.estimate import OcclusionModel
from maniskill_tomato.sensing.visible_fraction.improved import ImprovedModel
from maniskill_tomato.sensing.visible_fraction.sphere import SphereModel
from maniskill_tomato.sensing.visible_fraction.thesis import ThesisConfig, ThesisModel

OCCLUSION_MODELS: Final[dict[str, Callable[[], OcclusionModel]]] = {
    "thesis": ThesisModel,
    "thesis_watershed": lambda: ThesisModel(ThesisConfig(separation="watershed")),
    "thesis_classifier": lambda: ThesisModel(ThesisConfig(separation="polynomial")),
    "improved": ImprovedModel,
    "sphere": SphereModel,
    "amodal": AmodalModel,
}
"""What makes each model, with its defaults."""


def make_occlusion_model(name: str) -> OcclusionModel:
    """An occlusion model by its name in `OCCLUSION_MODELS`.

    Raises:
        InvalidInputError: There is none of this name.
    """
    if name not in OCCLUSION_MODELS:
        raise InvalidInputError.choice("an occlusion model", name, list(OCCLUSION_MODELS))
    return OCCLUSION_MODELS[name]()
