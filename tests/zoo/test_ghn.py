"""The hypernetwork's canvas."""

from __future__ import annotations

import pytest

from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.ghn import GHN


def test_a_wide_canvas_is_made_by_more_blocks_and_fills_wide_layers():
    ghn = GHN(42, 8, seed=0, widths=(256,), layers=4)
    wide = ghn.emit(Architecture(42, (256, 256, 256), 8))
    assert ghn.canvas == 256 and [tuple(layer.shape[1:]) for layer in wide.layers][1] == (256, 257)
    raw = wide.layers[1][0, :, :-1] * 256**0.5
    assert raw.std() == pytest.approx(0.6, rel=0.2) and (raw.std(0) > 0.01).all()
    assert {f"up{number}.weight" for number in range(1, 6)} <= set(ghn.state_dict())
    assert "up4.weight" not in GHN(42, 8, seed=0).state_dict()
    with pytest.raises(UserError, match="up to 64 wide, not 65 inputs"):
        GHN(65, 8, seed=0)
