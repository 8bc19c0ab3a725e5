"""What is no map, or no whole one, is refused and left alone; `check` tells what is wrong with one."""

import random
import re
import sqlite3
from contextlib import closing
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from map_support import contents, drive, load, new_map, new_store, removal

from lifelong_slam.errors import MapError
from lifelong_slam.mapping import codec
from lifelong_slam.mapping.map_check import check_map
from lifelong_slam.mapping.saved_map import MapUpdate
from lifelong_slam.mapping.store import MapStore


@pytest.fixture
def path(tmp_path):
    return tmp_path / "place.map"


# --- what is no map, or no whole one


def garbage(path):
    path.write_bytes(random.Random(0).randbytes(10_000))


def empty(path):
    path.touch()


def text(path):
    path.write_text("ply\nformat ascii 1.0\n")


def folder(path):
    path.mkdir()


def other_database(path):
    with closing(sqlite3.connect(path)) as db:
        db.executescript("PRAGMA journal_mode = WAL; CREATE TABLE songs (title TEXT)")


def newer_format(path):
    new_map(path)
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA user_version = 99")


def truncated(path):
    new_map(path)
    path.write_bytes(path.read_bytes()[:-5000])


def cut_to_its_header(path):
    new_map(path)
    path.write_bytes(path.read_bytes()[:100])


def with_unreadable_names(path):
    new_map(path)
    path.write_bytes(path.read_bytes().replace(b"CREATE TABLE", b"CREATE\xff\xffABLE"))


def overwritten_in_the_middle(path):
    new_map(path)
    data = bytearray(path.read_bytes())
    middle = len(data) // 8192 * 4096
    data[middle : middle + 4096] = bytes(4096)
    path.write_bytes(data)


@pytest.mark.parametrize("read_only", [True, False])
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (garbage, "not a database"),
        (empty, "not a map of lifelong_slam"),
        (text, "not a database|not a map"),
        (folder, "not a file"),
        (other_database, "not a map of lifelong_slam"),
        (newer_format, "map format 99; this version of lifelong_slam knows 1 to 3"),
        (truncated, "malformed|damaged"),
        (cut_to_its_header, "malformed|damaged|not a database"),
        (with_unreadable_names, "names of its tables"),
        (overwritten_in_the_middle, "malformed|damaged"),
    ],
)
def test_what_is_no_whole_map_is_refused_and_left_alone(path, make, message, read_only):
    make(path)
    before = {} if path.is_dir() else contents(path.parent)
    with pytest.raises(MapError, match=message) as raised:
        MapStore.open(path, read_only)
    assert str(path) in str(raised.value)
    with pytest.raises(MapError, match="there already"):
        new_store(path)
    assert path.is_dir() or contents(path.parent) == before


def arrays_in(value):
    """Yield the bytes of all arrays with anything in them in nested dataclasses, dicts and lists."""
    if is_dataclass(value):
        for field in fields(value):
            yield from arrays_in(getattr(value, field.name))
    elif isinstance(value, dict):
        yield from arrays_in(list(value.values()))
    elif isinstance(value, list):
        for entry in value:
            yield from arrays_in(entry)
    elif isinstance(value, np.ndarray) and value.size:
        yield value.tobytes()


def test_a_flipped_bit_is_either_an_error_or_changes_no_array(path):
    """Names, ids and other plain columns have no checksum."""
    new_map(path, 5)
    with MapStore.open(path) as store:
        store.write(MapUpdate(removed=[removal(4, 2, 3), removal(3, 2)], removed_edges=[3, 4]))
    expected = set(arrays_in(load(path)))
    whole = path.read_bytes()
    chance = random.Random(0)
    refused = 0
    for _ in range(150):
        damaged = bytearray(whole)
        damaged[chance.randrange(len(whole))] ^= 1 << chance.randrange(8)
        path.write_bytes(damaged)
        try:
            saved = load(path)
        except MapError:
            refused += 1
        else:
            assert set(arrays_in(saved)) <= expected
        assert path.read_bytes() == damaged
    assert refused > 15


@pytest.mark.parametrize("read_only", [True, False])
def test_opening_does_not_make_a_map(path, read_only):
    with pytest.raises(MapError, match="no such map"):
        MapStore.open(path, read_only)
    assert list(path.parent.iterdir()) == []


def test_a_map_where_no_folder_can_be_made_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises((MapError, OSError)):
        new_store(tmp_path / "file" / "place.map")


def test_a_damaged_blob_is_named(path):
    new_map(path)
    with closing(sqlite3.connect(path)) as db, db:
        (blob,) = db.execute("SELECT points FROM features WHERE id = 3").fetchone()
        db.execute("UPDATE features SET points = ? WHERE id = 3", (blob[:-1] + b"\0",))
    with pytest.raises(MapError, match=r"damaged: features 3, points: the checksum is wrong"):
        load(path)
    assert check_map(path) == ["features 3, points: the checksum is wrong"]


# --- check


def sql(path, *statements):
    with closing(sqlite3.connect(path)) as db, db:
        for statement in statements:
            db.execute(*statement) if isinstance(statement, tuple) else db.execute(statement)


BENT = codec.pack_matrix(np.diag([1.0, 1.0, 1.1, 1.0]))
MIRRORED = codec.pack_matrix(np.diag([1.0, 1.0, -1.0, 1.0]))
NOT_FINITE = codec.pack_matrix(np.full((4, 4), np.nan))
INDEFINITE = codec.pack_matrix(np.diag([1.0, 1, 1, 1, 1, -1e-9]))
ZERO = codec.pack_matrix(np.zeros((6, 6)))
LOPSIDED = codec.pack_matrix(np.eye(6) + np.eye(6, k=1) * 0.1)


@pytest.mark.parametrize(
    ("statements", "problem"),
    [
        (["DELETE FROM vertices WHERE id = 2"], "edges 2 names an entry that is not in vertices"),
        (["UPDATE scans SET anchor = 99 WHERE id = 1"], "scans 1 names .* not in keyframes"),
        (["DELETE FROM features WHERE id = 2"], "vertex 2 has no features"),
        (["INSERT INTO keyframes VALUES (9, 0, 1, 0.0)"], "keyframe 9 must be either"),
        (
            [("UPDATE vertices SET T_map = ? WHERE id = 1", (BENT,))],
            "pose of vertex 1: not a rigid",
        ),
        (
            [("UPDATE vertices SET T_odom = ? WHERE id = 1", (MIRRORED,))],
            "odometry of vertex 1: not",
        ),
        (
            [("UPDATE edges SET T_source_target = ? WHERE id = 1", (NOT_FINITE,))],
            "edges 1, T_source_target: it is not finite",
        ),
        (
            [("UPDATE edges SET covariance = ? WHERE id = 3", (INDEFINITE,))],
            "edge 3: not .* positive definite",
        ),
        (
            [("UPDATE vertices SET covariance = ? WHERE id = 3", (LOPSIDED,))],
            "vertex 3: not .* semidefinite",
        ),
        (["DELETE FROM edges WHERE id = 3"], "session 0: its vertices fall into 2 unconnected"),
        (["UPDATE edges SET rejected = TRUE WHERE id = 3"], "session 0: its vertices fall into 2"),
        (["UPDATE edges SET covariance = x'00' WHERE id = 1"], "edges 1, covariance: the checksum"),
        (["DELETE FROM map"], "table map has 0 rows"),
    ],
)
def test_check_tells_what_does_not_hold_together(path, statements, problem):
    new_map(path)
    assert check_map(path) == []
    sql(path, *statements)
    before = contents(path.parent)
    problems = check_map(path)
    assert re.search(problem, problems[0]), problems
    assert contents(path.parent) == before


def test_the_first_keyframe_may_be_exact_but_no_edge(path):
    new_map(path)
    sql(path, ("UPDATE vertices SET covariance = ? WHERE id = 0", (ZERO,)))
    assert check_map(path) == []
    sql(path, ("UPDATE edges SET covariance = ? WHERE id = 1", (ZERO,)))
    assert check_map(path) == ["covariance of edge 1: not symmetric and positive definite"]


@pytest.mark.parametrize(
    ("removals", "problem"),
    [
        ((removal(4, 3), removal(3, 0, 2)), None),
        ((removal(3, 0, 2), removal(4, 2, 3)), "keyframe 4 hangs on 3, which is neither"),
        ((removal(4, 0, 99),), "keyframe 4 hangs on 99, which is neither"),
        ((removal(4, 4, 0),), "keyframe 4 hangs on 4, which is neither"),
    ],
)
def test_a_removed_keyframe_must_hang_on_what_is_there_or_went_later(path, removals, problem):
    new_map(path)
    gone = {r.vertex for r in removals}
    with MapStore.open(path) as store:
        store.write(MapUpdate(removed=removals, removed_edges=gone))
    if problem is None:
        assert check_map(path) == []
        load(path).keyframe_poses()
    else:
        (found,) = check_map(path)
        assert found.startswith(problem)
        with pytest.raises(MapError, match=problem):
            load(path).trajectory()


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"T_neighbour_vertex": np.diag([1.0, 1.0, 1.1, 1.0])}, "its pose .* not a rigid motion"),
        ({"T_neighbour_vertex": np.full((4, 4), np.nan)}, "its pose .* not a rigid motion"),
        ({"gains": 0.499 * np.eye(6)}, "its gains don't sum to the identity"),
        ({"gains": np.full((6, 6), np.nan)}, "its gains don't sum to the identity"),
    ],
)
def test_check_finds_a_removed_keyframe_that_cannot_come_back(path, change, problem):
    new_map(path)
    wrong = {name: np.stack([array, array]) for name, array in change.items()}
    with MapStore.open(path) as store:
        store.write(MapUpdate(removed=[removal(4, 0, 1)], removed_edges=[4]))
        store.write(MapUpdate(removed=[replace(removal(3, 0, 1), **wrong)], removed_edges=[3]))
    (found,) = check_map(path)
    assert re.match(f"keyframe 3: {problem}", found)


def test_a_removed_keyframe_has_a_pose_and_a_gain_for_each_neighbour(path):
    new_map(path)
    whole = removal(4, 0, 1)
    with MapStore.open(path) as store:
        cut = replace(whole, gains=whole.gains[:1])
        store.write(MapUpdate(removed=[cut], removed_edges=[4]))
    (problem,) = check_map(path)
    assert problem.startswith("removals 1, support: it needs a pose and a gain for each")
    with pytest.raises(MapError, match="removals 1, support"):
        load(path)


def test_check_finds_a_session_that_is_wrongly_called_located(path):
    new_map(path)
    with MapStore.open(path) as store:
        session = store.begin_session("second", "")
        store.write(drive(5, session, start=5))
    assert check_map(path) == []
    sql(path, "UPDATE sessions SET located = TRUE")
    assert check_map(path) == ["session 1 counts as located, but no edges join it to earlier ones"]


def test_check_compares_each_index_with_its_table(path):
    new_map(path)
    with closing(sqlite3.connect(path)) as db:
        roots = dict(db.execute("SELECT name, rootpage FROM sqlite_schema WHERE type = 'index'"))
        (size,) = db.execute("PRAGMA page_size").fetchone()
    data = bytearray(path.read_bytes())
    one, other = (size * (roots[f"edges_of_{end}"] - 1) for end in ("source", "target"))
    data[one : one + size] = data[other : other + size]
    path.write_bytes(data)
    assert "row 1 missing from index edges_of_source" in check_map(path)


def test_check_does_not_read_on_where_pages_are_missing(path):
    truncated(path)
    with pytest.raises(MapError, match="malformed"):
        check_map(path)
