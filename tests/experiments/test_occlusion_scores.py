"""Errors of occlusion models on annotated images, summed up."""

import pytest

from maniskill_tomato.experiments.occlusion_scores import Judged, by_band, markdown, score


def test_scores_follow_from_the_errors() -> None:
    def one(truth: float, estimate: float) -> Judged:
        return Judged(
            model="m", file_name="a", category="tomato", visible_px=1, truth=truth, estimate=estimate
        )

    judged = [one(0.1, 0.2), one(0.9, 0.8), one(0.5, float("nan"))]
    result = score(judged)
    assert result.mae == pytest.approx((0.1 + 0.1 + 0.5) / 3) and result.failures == 1
    assert result.bias == pytest.approx(0.0) and result.rmse == pytest.approx(0.1)
    assert [s.count for _, s in by_band(judged)] == [1, 0, 1, 0, 1, 0]
    assert "| m | 3 | 0.233 |" in markdown(judged, {"m": 3.0})
