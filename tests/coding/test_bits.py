# SPDX-License-Identifier: Apache-2.0
"""Bit fields of the high-level syntax."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ggslam.coding.bits import BitReader, BitWriter
from ggslam.errors import FormatError


def written(method: str, *arguments: int) -> str:
    """The bits a writer adds, as digits."""
    writer = BitWriter()
    writer.u(1, 1)  # so that leading zeros show
    getattr(writer, method)(*arguments)
    digits = f"{writer._value:b}"[1:]
    return digits


@pytest.mark.parametrize(
    ("value", "bits"), [(0, "0"), (1, "100"), (2, "101"), (3, "11000"), (6, "11011"), (7, "1110000")]
)
def test_golomb_codes_have_a_prefix_of_ones(value: int, bits: str) -> None:
    assert written("ue", value) == bits


@pytest.mark.parametrize(("value", "code"), [(0, 0), (1, 1), (-1, 2), (2, 3), (-2, 4), (-51, 102)])
def test_signed_golomb_codes_alternate(value: int, code: int) -> None:
    assert written("se", value) == written("ue", code)


def test_signed_fields_have_the_sign_last() -> None:
    assert written("s", 4, -5) == "01011"


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])  # a busy machine is no fault of the bits
@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("ue"), st.integers(0, 2**31)),
            st.tuples(st.just("se"), st.integers(-(2**30), 2**30)),
            st.tuples(st.just("u"), st.integers(0, 2**17 - 1)),
            st.tuples(st.just("s"), st.integers(-(2**17) + 1, 2**17 - 1)),
            st.tuples(st.just("align"), st.just(0)),
        )
    )
)
def test_fields_come_back(fields: list[tuple[str, int]]) -> None:
    writer = BitWriter()
    for kind, value in fields:
        if kind == "align":
            writer.align()
        else:
            getattr(writer, kind)(*([17] if kind in "us" else []), value)
    reader = BitReader(writer.data(), "fields")
    for kind, value in fields:
        if kind == "align":
            reader.align()
        else:
            assert getattr(reader, kind)(*([17] if kind in "us" else [])) == value
    reader.finish()


def test_reading_past_the_end_is_refused() -> None:
    reader = BitReader(b"\x80", "a header")
    assert reader.u(7) == 64
    with pytest.raises(FormatError, match="a header ends early"):
        reader.u(2)


def test_an_endless_prefix_is_refused() -> None:
    with pytest.raises(FormatError, match="impossible number"):
        BitReader(b"\xff" * 100, "a header").ue()


def test_leftovers_are_refused() -> None:
    reader = BitReader(b"\x00\x00", "a header")
    reader.u(3)
    with pytest.raises(FormatError, match="longer than its syntax"):
        reader.finish()
    reader = BitReader(b"\x01", "a header")
    reader.u(3)
    with pytest.raises(FormatError, match="alignment bits"):
        reader.finish()


def test_values_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        BitWriter().u(3, 8)
    with pytest.raises(ValueError, match="no exponential Golomb code"):
        BitWriter().ue(-1)
