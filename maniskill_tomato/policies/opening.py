"""The one way to a policy: by its name or from its file."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from maniskill_tomato.errors import PolicyError, TomatoError, did_you_mean
from maniskill_tomato.extension_points import is_import_path
from maniskill_tomato.policies.layout import has_belief
from maniskill_tomato.policies.registry import (
    PLANNERS,
    PRIVILEGED,
    SHIPPED_FILES,
    PolicyContext,
    make_planner,
    policy_names,
)
from maniskill_tomato.task_registry import GENERAL_IDS

if TYPE_CHECKING:
    import torch

    from maniskill_tomato.policies.protocol import GroundTruth, Policy

RANDOM: Final = "random"
"""Uniformly random actions, in every task."""


def find_policy(name_or_file: str | Path, env_id: str | None = None) -> str | Path:
    """The name or the file of a policy, checked without opening it, which costs seconds of imports.

    Args:
        name_or_file: As for `open_policy`.
        env_id: As for `open_policy`.

    Raises:
        PolicyError: There is no such name and no such file, or a named policy cannot act in the task.
    """
    text = str(name_or_file)
    names = policy_names()
    if text == RANDOM:
        return text
    if is_import_path(text):
        return text
    if text in names:
        if text in PLANNERS and env_id is not None and not has_belief(env_id):
            raise PolicyError(
                f"{text} plans on a belief, which {', '.join(GENERAL_IDS)} have and {env_id} has not; give a policy "
                f"that was trained on {env_id}, or {RANDOM!r}"
            )
        return text
    path = Path(text)
    if not path.is_file():
        known = (RANDOM, *names) if env_id is None or has_belief(env_id) else (RANDOM,)
        beside = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
        raise PolicyError(
            f"no policy at {text!r}; give a .pt or .onnx file, or one of {', '.join(known)}, "
            "or package.module:callable"
            f"{did_you_mean(text, known) or did_you_mean(path.name, beside)}"
        )
    return path


def needs_colours(found: str | Path) -> bool:
    """Whether a policy observes colours, so that its environments need a renderer.

    Args:
        found: What `find_policy` gave.

    Raises:
        PolicyError: Its file cannot be read.
    """
    if not isinstance(found, Path):
        return False
    try:
        if found.suffix.lower() in (".onnx", ".json"):
            from maniskill_tomato.policies.onnx_policy import OnnxPolicy

            sight = OnnxPolicy.load(found).description.sight
        else:
            from maniskill_tomato.files import read_tensors
            from maniskill_tomato.policies.trained_actor import sight_of

            content = read_tensors(found)
            config = content.get("config") if isinstance(content, dict) else None
            sight = sight_of(config) if isinstance(config, dict) else None
    except PolicyError:
        raise
    except TomatoError as error:
        raise PolicyError(str(error)) from error
    return sight is not None and sight.images.needs_colours


def open_policy(
    name_or_file: str | Path,
    *,
    env_id: str | None = None,
    ground_truth: "GroundTruth | None" = None,
    contact_free: bool = False,
    seed: int = 0,
    device: "str | torch.device" = "cpu",
) -> "Policy":
    """A policy, ready to act.

    Args:
        name_or_file: A name of `registry.policy_names`, `random`, `package.module:callable`, or a file of a policy that
            was trained (.pt) or exported (.onnx, with its .json).
        env_id: The task that it must fit; None accepts any.
        ground_truth: The environment's knowledge, for policies with `needs_truth`.
        contact_free: Whether the oracle touches no plant.
        seed: Of its random numbers.
        device: Where the environment's tensors are.

    Returns:
        A policy that acts on beliefs; where it decides from state vectors, it is an `adapters.ObservationPolicy` and
        acts on observations too.

    Raises:
        PolicyError: It is unknown, missing, damaged, for another task, or needs a truth that is not given.
    """
    found = find_policy(name_or_file, env_id)
    context = PolicyContext(seed=seed, device=device, ground_truth=ground_truth, contact_free=contact_free)
    try:
        if isinstance(found, Path):
            return _open_file(found, env_id, context)
        if found == RANDOM:
            return _random(env_id, context)
        if found in SHIPPED_FILES:
            return _open_file(_asset(SHIPPED_FILES[found]), env_id, context)
        if found in PRIVILEGED and ground_truth is None:
            raise PolicyError(
                f"{found} knows what no camera could tell; it runs in simulation only, with the "
                "environment's ground_truth"
            )
        return make_planner(found, context)
    except PolicyError:
        raise
    except TomatoError as error:
        raise PolicyError(str(error)) from error


def shipped_policy(env_id: str) -> Path:
    """File of the trained policy that ships with the package.

    Raises:
        PolicyError: None ships for this task.
    """
    try:
        # One policy serves all tasks with a belief.
        return _asset(f"policies/{GENERAL_IDS[0] if has_belief(env_id) else env_id}.pt")
    except PolicyError:
        how = (
            "give --policy a planner's name such as nbv, or train one with `maniskill-tomato train-view-quality`"
            if has_belief(env_id)
            else f"train one with `maniskill-tomato train {env_id}`"
        )
        raise PolicyError(
            f"no policy for {env_id} ships with this version; {how} and give its policy.pt with --policy"
        ) from None


def _asset(name: str) -> Path:
    from maniskill_tomato.assets import asset_path

    try:
        return asset_path(name)
    except FileNotFoundError as error:
        raise PolicyError(f"{Path(name).name} does not ship with this version; give another file") from error


def _random(env_id: str | None, context: PolicyContext) -> "Policy":
    if env_id is None or has_belief(env_id):
        return make_planner("random_step", context)
    from maniskill_tomato.policies.adapters import ObservationPolicy
    from maniskill_tomato.policies.baselines import RandomIncrements

    return ObservationPolicy(RandomIncrements(context.seed, context.device), name=RANDOM)


def _open_file(path: Path, env_id: str | None, context: PolicyContext) -> "Policy":
    if path.suffix.lower() in (".onnx", ".json"):
        from maniskill_tomato.policies.adapters import ExportedActor
        from maniskill_tomato.policies.onnx_policy import OnnxPolicy

        exported = ExportedActor(OnnxPolicy.load(path, env_id))
        return _acting(exported, exported.sight)
    from maniskill_tomato.files import read_tensors

    content = read_tensors(path)
    kind = content.get("format") if isinstance(content, dict) else None
    if isinstance(kind, str):
        return _open_network(path, kind, env_id, context)
    from maniskill_tomato.policies.trained_actor import load_actor

    actor = load_actor(path, context.device, env_id)
    return _acting(actor, actor.sight)


def _acting(actor: Any, sight: Any) -> "Policy":
    """A trained actor as a policy, by whether it sees images."""
    from maniskill_tomato.policies.adapters import ObservationPolicy
    from maniskill_tomato.policies.pixel_policy import PixelPolicy

    return ObservationPolicy(actor) if sight is None else PixelPolicy(actor, sight)


def _open_network(path: Path, kind: str, env_id: str | None, context: PolicyContext) -> "Policy":
    """A policy that decides from beliefs with a network of its own."""
    from maniskill_tomato.policies import deep_move_to_see, recurrent, view_quality

    loaders: dict[str, Callable[[Path, Any], Policy]] = {
        deep_move_to_see.FORMAT: deep_move_to_see.load_deep_move_to_see,
        recurrent.FORMAT: recurrent.load_recurrent,
        view_quality.FORMAT: view_quality.load_view_quality,
    }
    if kind not in loaders:
        raise PolicyError(f"{path} has format {kind!r}; this version reads {', '.join(loaders)}")
    if env_id is not None and not has_belief(env_id):
        raise PolicyError(f"{path} is a policy for {', '.join(GENERAL_IDS)}, not for {env_id}")
    return loaders[kind](path, context.device)
