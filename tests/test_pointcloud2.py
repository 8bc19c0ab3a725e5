import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sources_support import cloud_message, xyz

from lifelong_slam.errors import SourceError
from lifelong_slam.sources.pointcloud2 import decode

KINDS = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]


@st.composite
def layouts(draw):
    height = draw(st.integers(1, 4))
    count = height * draw(st.integers(1, 5))
    names = draw(st.permutations(["x", "y", "z", "t", "ring"]))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    columns = {}
    for name in names:
        kind = np.dtype(draw(st.sampled_from(KINDS)))
        columns[name] = rng.uniform(0, 100, count).astype(kind)
    padding = st.integers(0, 7)
    return columns, {
        "height": height,
        "gaps": draw(st.lists(padding, min_size=5, max_size=5)),
        "point_padding": draw(padding),
        "row_padding": draw(padding),
        "big_endian": draw(st.booleans()),
    }


@settings(max_examples=150, deadline=None)
@given(layouts())
def test_any_layout_comes_back(layout):
    columns, options = layout
    cloud = decode(cloud_message(columns, **options))
    expected = np.column_stack([columns[name] for name in "xyz"]).astype(np.float64)
    np.testing.assert_array_equal(cloud.points, expected)
    np.testing.assert_array_equal(cloud.times["t"], columns["t"])
    assert cloud.times["t"].dtype == columns["t"].dtype  # and so in native byte order
    assert list(cloud.times) == ["t"]


def test_nan_points_are_kept_with_their_times():
    columns = xyz(5) | {"time": np.arange(5, dtype=np.float32)}
    columns["y"][2] = np.nan
    cloud = decode(cloud_message(columns))
    assert np.isnan(cloud.points[2, 1])
    np.testing.assert_array_equal(cloud.times["time"], np.arange(5))


def test_empty_cloud():
    cloud = decode(cloud_message({name: values[:0] for name, values in xyz().items()}))
    assert cloud.points.shape == (0, 3)


def test_missing_coordinates_are_named_with_the_fields_there_are():
    columns = xyz()
    columns["range"] = columns.pop("z")
    with pytest.raises(SourceError, match=r"without z.*fields are x, y, range"):
        decode(cloud_message(columns))


def test_unset_row_step_is_forgiven():
    message = cloud_message(xyz(12), height=3)
    message.row_step = 0
    assert len(decode(message).points) == 12


@pytest.mark.parametrize("change", [{"width": 100}, {"point_step": 6}, {"height": 7}])
def test_sizes_that_do_not_fit_are_refused(change):
    message = cloud_message(xyz(12), height=3)
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(ValueError, match=r"bytes of data|beyond its point"):
        decode(message)


def test_undefined_datatype_is_refused():
    message = cloud_message(xyz())
    message.fields[0].datatype = 77
    with pytest.raises(ValueError, match="datatype"):
        decode(message)


def lengths(kind, count=500):
    """Columns of a street scene: ranges of 1 to 80 m."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(count, 3))
    points = directions / np.linalg.norm(directions, axis=1)[:, None]
    points *= np.geomspace(1, 80, count)[:, None]
    return dict(zip("xyz", points.T.astype(kind), strict=True))


@pytest.mark.parametrize("big_endian", [True, False])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("missing", [0.0, np.nan, None])
def test_a_wrong_byte_order_is_noticed(big_endian, kind, scale, missing):
    columns = {name: values * kind(scale) for name, values in lengths(kind).items()}
    columns["t"] = np.arange(500, dtype=np.uint32) * 200_000
    if missing is not None:
        for axis in "xyz":
            columns[axis][100:] = missing  # points without return
    message = cloud_message(columns, big_endian=big_endian)
    truth = decode(message)
    assert not truth.swapped
    message.is_bigendian = not big_endian
    cloud = decode(message)
    assert cloud.swapped
    np.testing.assert_array_equal(cloud.points, truth.points)
    np.testing.assert_array_equal(cloud.times["t"], columns["t"])


@pytest.mark.parametrize("rows", [1, 50])
def test_coordinates_of_few_bits_are_judged_as_well(rows):
    columns = {n: np.round(v * 256) / np.float32(256) for n, v in lengths(np.float32).items()}
    message = cloud_message(columns, height=rows)
    assert not decode(message).swapped
    message.is_bigendian = True
    assert decode(message).swapped


def test_a_message_as_its_constructor_left_it_is_an_empty_cloud():
    message = cloud_message({name: values[:0] for name, values in xyz().items()})
    message.fields, message.height, message.point_step = [], 0, 0
    assert decode(message).points.shape == (0, 3)
