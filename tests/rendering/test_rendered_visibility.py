"""The visible fraction by rays against rendered segmentation images."""

import numpy as np
import pytest

pytestmark = pytest.mark.render


@pytest.mark.parametrize(
    ("plants", "fewest"), [(6, 1), pytest.param(30, 15, marks=pytest.mark.slow)], ids=["6", "30"]
)
def test_rays_agree_with_segmentation_images_of_ten_views_of_each_plant(
    capsys: pytest.CaptureFixture[str], plants: int, fewest: int
) -> None:
    from maniskill_tomato.rendering.rendered_visibility import compare

    views = compare(num_plants=plants, views_per_plant=10)
    rendered = np.array([view.rendered for view in views])
    differences = np.abs([view.difference for view in views])
    with capsys.disabled():
        print(
            f"\n{len(views)} views: mean absolute difference {differences.mean():.4f}, max {differences.max():.4f}"
        )
    assert len(views) == 10 * plants
    assert len({(view.preset, view.seed) for view in views}) == plants
    # The views must ask something: hidden, half visible and free targets all occur.
    assert np.histogram(rendered, bins=5, range=(0, 1))[0].min() >= fewest
    assert differences.mean() < 0.02
    assert differences.max() < 0.08
