"""The light network in ONNX Runtime, on one core 1.8 times as quick as in PyTorch: convolutions of single channels are
slow there."""

import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import onnxruntime
import torch
from torch import Tensor

from maniskill_tomato.segmentation.fruit_network import SIZE_MULTIPLE, FruitMaps, FruitNetwork


class FruitSession:
    """A trained `FruitNetwork`, for looking at one image at a time."""

    def __init__(self, network: FruitNetwork) -> None:
        """Translates the network as it is now; it uses as many threads as PyTorch does.

        Args:
            network: It is set to evaluation mode.
        """
        network = network.eval().requires_grad_(False)
        example = torch.zeros(1, 3, 2 * SIZE_MULTIPLE, 2 * SIZE_MULTIPLE)
        with warnings.catch_warnings(), TemporaryDirectory() as folder:
            path = Path(folder) / "fruit.onnx"
            # The exporter by tracing is called old; the new one would need two more packages.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                network,
                (example,),
                path,
                dynamo=False,
                input_names=["image"],
                output_names=list(FruitMaps._fields),
                dynamic_axes={"image": {2: "height", 3: "width"}},
            )
            translated = path.read_bytes()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(translated, options, providers=["CPUExecutionProvider"])

    def __call__(self, image: Tensor) -> FruitMaps:
        """The maps for one image of colours from 0 to 255. Shape (1, 3, H, W), multiples of `SIZE_MULTIPLE`."""
        outputs = self._session.run(None, {"image": image.contiguous().numpy()})
        return FruitMaps(*(torch.from_numpy(output) for output in outputs))
