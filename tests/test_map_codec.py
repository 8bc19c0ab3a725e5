"""Arrays and clouds as the blobs of a map file: what is packed is unpacked, and damage is noticed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from map_support import assert_same, cloud, voxels
from scipy.spatial import cKDTree

from lifelong_slam.mapping import codec


def unpacked_again(arrays):
    layout = {n: (a.dtype.newbyteorder("<").str, a.shape[1:]) for n, a in arrays.items()}
    return codec.unpack(codec.pack(arrays), layout)


@given(
    hnp.arrays(
        dtype=st.one_of(
            hnp.integer_dtypes(), hnp.floating_dtypes(sizes=(32, 64)), hnp.boolean_dtypes()
        ),
        shape=hnp.array_shapes(min_dims=0, min_side=0, max_side=5),
    )
)
def test_arrays_come_back_as_they_were(array):
    (name, unpacked), *more = unpacked_again({"a": array}).items()
    assert (name, more) == ("a", [])
    assert unpacked.dtype == array.dtype.newbyteorder("<")
    np.testing.assert_array_equal(unpacked, array)


def test_arrays_keep_their_names_apart():
    arrays = voxels(np.random.default_rng(1))
    unpacked = unpacked_again(arrays)
    assert_same(unpacked, arrays)
    assert all(array.flags.writeable for array in unpacked.values())


@settings(deadline=None)
@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(0, 40), st.just(3)),
        elements=st.floats(-900, 900, width=32),
    )
)
def test_points_come_back_to_half_a_millimetre_in_any_order(points):
    unpacked = codec.unpack_points(codec.pack_points(points))
    assert unpacked.shape == points.shape
    assert unpacked.dtype == np.float32
    if len(points):
        error = 0.5 * codec.POINT_RESOLUTION * np.sqrt(3) + 2e-4  # and that of float32 at 900 m
        assert cKDTree(unpacked).query(points)[0].max() < error
        assert cKDTree(points).query(unpacked)[0].max() < error


def test_packing_points_again_loses_nothing_more():
    blob = codec.pack_points(cloud(np.random.default_rng(0), 5000))
    assert codec.pack_points(codec.unpack_points(blob)) == blob


def test_points_on_surfaces_take_less_than_half_of_float32():
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-40, 40, (20_000, 2)), rng.normal(0, 0.02, 20_000)])
    points = ground.astype(np.float32)
    assert len(codec.pack_points(points)) < 0.5 * points.nbytes


@pytest.mark.parametrize(
    ("value", "message"), [(np.nan, "finite"), (np.inf, "finite"), (3000.0, "2097 m")]
)
def test_points_that_cannot_be_stored_are_refused(value, message):
    points = np.zeros((4, 3), np.float32)
    points[2, 1] = value
    with pytest.raises(ValueError, match=message):
        codec.pack_points(points)


def test_every_flipped_bit_of_a_blob_is_noticed():
    blob = codec.pack_points(cloud(np.random.default_rng(0), 10))
    for bit in range(8 * len(blob)):
        damaged = bytearray(blob)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ValueError, match="checksum"):
            codec.unpack_points(bytes(damaged))
