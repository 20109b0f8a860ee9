"""A trained policy from an ONNX file and its description, ready to act on hardware."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

from maniskill_tomato.errors import InvalidInputError, PolicyError
from maniskill_tomato.policies.description import IMAGE_MEANINGS, INPUT_NAME, OUTPUT_NAME, PolicyDescription
from maniskill_tomato.sensing.image_layout import check_images
from maniskill_tomato.task_registry import is_same_task

_EXPORT_AGAIN = "run `maniskill-tomato export` again"


def description_path(path: Path) -> Path:
    """Where the description of the ONNX file `path` is: beside it, with the ending .json."""
    return path.with_suffix(".json")


class OnnxPolicy:
    """What `maniskill-tomato export` wrote, loaded: observations in, pose increments out.

    The graph holds the normaliser, the actor, the action scale and the action bounds.
    """

    def __init__(self, session: onnxruntime.InferenceSession, description: PolicyDescription) -> None:
        """Use `OnnxPolicy.load`, which checks that the two belong together."""
        self._session = session
        self.description = description

    @classmethod
    def load(cls, path: Path | str, env_id: str | None = None) -> "OnnxPolicy":
        """Reads NAME.onnx and, from the same folder, NAME.json.

        Args:
            path: The ONNX file.
            env_id: The task that it must have been trained on; None accepts any.

        Raises:
            PolicyError: A file is missing, damaged, of a newer format or another layout, the two do not belong
                together, or the policy was trained on another task.
        """
        path = Path(path)
        description_file = description_path(path)
        if description_file == path:
            raise PolicyError(f"{path} is a description; give the ONNX file beside it")
        model = _read(path, "exported policy")
        text = _read(description_file, "description of the exported policy").decode(errors="replace")
        try:
            description = PolicyDescription.from_json(text)
        except PolicyError as error:
            raise PolicyError(f"{description_file} cannot be used: {error}") from error
        if hashlib.sha256(model).hexdigest() != description.onnx_sha256:
            raise PolicyError(
                f"{path} is not the file that {description_file.name} describes (their SHA-256 differ): one of them "
                f"is damaged or belongs to another policy; {_EXPORT_AGAIN}"
            )
        if env_id is not None and not is_same_task(description.env_id, env_id):
            raise PolicyError(
                f"{path} was trained on {description.env_id}, not on {env_id}; give a policy of this task "
                "(`maniskill-tomato eval` tries any with --allow-other-task)"
            )
        return cls.from_bytes(model, description, path)

    @classmethod
    def from_bytes(cls, model: bytes, description: PolicyDescription, path: Path) -> "OnnxPolicy":
        """The policy of an ONNX file's content; `path` only names it in messages.

        Raises:
            PolicyError: ONNX Runtime cannot load it, or it has another input or output than described.
        """
        policy = cls(_open_session(path, model), description)
        policy._check_graph(path)
        return policy

    def act(
        self, observations: ArrayLike, images: Mapping[str, NDArray[Any]] | None = None
    ) -> NDArray[np.float32]:
        """The actions for a batch of observations.

        Args:
            observations: As the description says, for the thesis's tasks end-effector x, y, z [m], roll, pitch, yaw
                [rad], target x, y, z [m], world frame; float32 or what converts to it. Shape (B, D).
            images: Those of the description's `sight` by kind, each of shape (B, H, W, C); None without one.

        Returns:
            Increments dx, dy, dz [m], droll, dpitch, dyaw [rad]. Shape (B, 6).

        Raises:
            InvalidInputError: The observations have another shape, are not real numbers, or are not finite
                as float32.
            PolicyError: The actions are not finite.
        """
        given = np.asarray(observations)
        width = len(self.description.observation)
        if given.dtype.kind not in "fiu":
            raise InvalidInputError(f"observations must be real numbers, got dtype {given.dtype}")
        if given.ndim != 2 or given.shape[1] != width:
            raise InvalidInputError(f"observations must have shape (B, {width}), got {given.shape}")
        with np.errstate(over="ignore"):
            values = np.ascontiguousarray(given, dtype=np.float32)
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            name = self.description.observation[column].name
            raise InvalidInputError(
                f"observations must be finite; {name} of observation {row} is {given[row, column]}"
            )
        inputs: dict[str, NDArray[Any]] = {INPUT_NAME: values}
        if (sight := self.description.sight) is not None:
            check_images(images or {}, sight, len(values))
            for kind in sight.images.kinds:
                dtype = IMAGE_MEANINGS[kind][0]
                if (given := np.asarray((images or {})[kind])).dtype != dtype:
                    raise InvalidInputError(f"this policy observes {kind} as {dtype}, got {given.dtype}")
                inputs[kind] = given
        (output,) = self._session.run([OUTPUT_NAME], inputs)
        actions = np.asarray(output, dtype=np.float32)
        if not np.isfinite(actions).all():
            raise PolicyError("the policy answered with actions that are not finite; the arm must not move")
        return actions

    def describe(self) -> dict[str, Any]:
        """Where it comes from, for reports."""
        training = self.description.training
        return {
            "kind": f"{training.get('algorithm')}, ONNX",
            "trained_on": self.description.env_id,
            "trained_with": self.description.trained_with,
            "training_steps": training.get("steps"),
            "training_episodes": training.get("episodes"),
            "training_seed": training.get("seed"),
            "package_version": self.description.package_version,
        }

    def _check_graph(self, path: Path) -> None:
        """Refuses a graph with another input or output than the description's."""
        inputs = [(INPUT_NAME, "tensor(float)", [len(self.description.observation)])]
        if (sight := self.description.sight) is not None:
            inputs += [
                (kind, f"tensor({IMAGE_MEANINGS[kind][0]})", list(shape))
                for kind, shape in sight.shapes.items()
            ]
        ends = (
            (self._session.get_inputs(), inputs),
            (self._session.get_outputs(), [(OUTPUT_NAME, "tensor(float)", [len(self.description.action)])]),
        )
        for nodes, wanted in ends:
            got = [(node.name, node.type, list(node.shape)[1:]) for node in nodes]
            if got != wanted:
                listed = " and ".join(f"{name!r} of shape {('batch', *shape)}" for name, _, shape in wanted)
                raise PolicyError(f"{path} must have one tensor {listed}, got {got}; {_EXPORT_AGAIN}")


def _read(path: Path, what: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise PolicyError(
            f"cannot read the {what} {path} ({error.strerror or error}); `maniskill-tomato export` writes "
            "NAME.onnx and NAME.json, which must stay together"
        ) from error


def _open_session(path: Path, model: bytes) -> onnxruntime.InferenceSession:
    options: Any = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # The networks are too small to gain from more.
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # What goes wrong becomes an exception; warnings would only repeat it.
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's own exceptions have no common base.
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise PolicyError(f"ONNX Runtime cannot load {path} ({reason}); {_EXPORT_AGAIN}") from error
