"""The SDK's depth filters in the order that it documents, restarted at every viewpoint."""

from typing import Any

from maniskill_tomato.deploy.realsense.realsense_config import RealSenseConfig


class DepthFilters:
    """Decimation, then in disparity spatial and temporal smoothing, then back in depth the filling of holes."""

    def __init__(self, sdk: Any, config: RealSenseConfig) -> None:
        """Makes the filters that the configuration asks for.

        Args:
            sdk: The module `pyrealsense2`.
            config: Which ones.
        """
        self._sdk = sdk
        self._config = config
        self._chain: list[Any] = []
        self.restart()

    def restart(self) -> None:
        """Forgets earlier pictures: the temporal filter takes for granted that nothing moves."""
        sdk, config = self._sdk, self._config
        in_disparity = []
        if config.spatial:
            in_disparity.append(sdk.spatial_filter())
        if config.temporal:
            in_disparity.append(sdk.temporal_filter())
        self._chain = []
        if config.decimation > 1:
            decimation = sdk.decimation_filter()
            decimation.set_option(sdk.option.filter_magnitude, config.decimation)
            self._chain.append(decimation)
        if in_disparity:
            self._chain += [sdk.disparity_transform(True), *in_disparity, sdk.disparity_transform(False)]
        if config.hole_filling:
            self._chain.append(sdk.hole_filling_filter())

    def process(self, frames: Any) -> Any:
        """The frameset with its depth filtered; colour is left alone."""
        for block in self._chain:
            frames = block.process(frames).as_frameset()
        return frames
