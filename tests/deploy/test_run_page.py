"""The pictures of a run: no caption is cut, however long it is."""

import cv2
import numpy as np
import pytest

from maniskill_tomato.deploy.policy_run import ContactSheet, wrap_text
from maniskill_tomato.deploy.run_page import Look

DETAIL = (
    "refused: the way to the view would bring the elbow within 12 mm of the stem of the third plant of the row, and "
    "no other posture of the arm reaches it"
)


def width_of(text: str, size: float) -> int:
    return int(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0])


@pytest.mark.parametrize("text", [DETAIL, "short", "a" * 200, f"{'b' * 90} and {'c' * 90}", ""])
def test_wrapped_lines_fit_and_hold_every_letter(text: str) -> None:
    lines = wrap_text(text, 200, 0.36)
    assert all(width_of(line, 0.36) <= 200 for line in lines)
    assert "".join(lines).replace(" ", "") == text.replace(" ", "")


def look(outcome: str) -> Look:
    return Look(picture=np.full((120, 160, 3), 90, dtype=np.uint8), title="3: V_f 0.45", outcome=outcome)


def text_rows(picture: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> int:
    """Lines of dark text on white."""
    dark = (picture.max(axis=2) < 200).any(axis=1)
    return int((np.diff(dark.astype(int)) == 1).sum())


def test_the_contact_sheet_grows_with_its_captions_and_cuts_none() -> None:
    sheet = ContactSheet()
    sheet.looks = [look("moved"), look(DETAIL)]
    title = f"{'a profile with a very long name' * 4}, seed 3, view_quality: success"
    picture = sheet.picture(title)
    head = wrap_text(title, picture.shape[1] - 20, 0.55)
    caption = wrap_text(DETAIL, 152, 0.36)
    assert len(head) > 3 and len(caption) >= 5
    # White round everything: no letter reaches an edge, and none is hidden below the next picture.
    for edge in (picture[0], picture[-1], picture[:, 0], picture[:, -1]):
        assert (edge == 255).all()
    right = picture[12 + 22 * len(head) + 121 :, 8 + 168 :]
    assert text_rows(right) >= 1 + len(caption)
