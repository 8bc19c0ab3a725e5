"""What lies beside a map: its own log is taken in, any other one is not and is kept."""

import logging
import multiprocessing
import os
import random
import signal
import sqlite3
from contextlib import closing
from itertools import product

import pytest
from map_support import (
    assert_same,
    contents,
    drive,
    load,
    make_older,
    new_map,
    new_store,
    open_and_close,
    write_and_die,
)

from lifelong_slam.mapping import map_log
from lifelong_slam.mapping.map_check import check_map
from lifelong_slam.mapping.store import MapStore

PAGE = 4096


@pytest.fixture
def path(tmp_path):
    return tmp_path / "place.map"


def log_of(path):
    return path.with_name(f"{path.name}-wal")


def in_a_child(target, *arguments):
    child = multiprocessing.get_context("fork").Process(target=target, args=arguments)
    child.start()
    child.join()


def put(path, main, log=None):
    """Have a folder hold a map file, what lies beside it, and nothing else."""
    for file in path.parent.iterdir():
        file.unlink()
    path.write_bytes(main)
    if log is not None:
        log_of(path).write_bytes(log)


def session_killed(path):
    """Have a session of one keyframe killed; return the map and its log as they are then."""
    in_a_child(add_and_die, path)
    return path.read_bytes(), log_of(path).read_bytes()


def add_and_die(path, points=60, longest_log=5 * PAGE):
    """Add a session of some keyframes to a map, and end without closing it."""
    map_log._LONGEST = longest_log
    store = MapStore.open(path)
    first = store.load().next_keyframe
    session = store.begin_session("short", "")
    for i in range(first, first + 3):
        store.write(drive(i, session, first, points))
    store._connection.execute("UPDATE sessions SET source = 'killed'")
    os.kill(os.getpid(), signal.SIGKILL)


def lives(path):
    """Return (map, log) of two maps of one name at many moments of their lives; None is no log."""
    found = []
    for _ in range(2):
        path.unlink(missing_ok=True)
        new_map(path, 2)
        found.append((path.read_bytes(), None))
        found += [session_killed(path) for _ in range(2)]
        MapStore.open(path).close()
        found.append((path.read_bytes(), None))
    path.unlink()
    return found


def test_a_log_is_taken_in_by_its_own_map_only(path):
    pairs = lives(path)
    alone, together = {}, {}
    for main, log in pairs:
        put(path, main)
        alone[main] = load(path)
        put(path, main, log)
        together[main, log] = load(path)
    assert len({len(saved.sessions) for saved in together.values()}) == 3
    for main, log in product(alone, {log for _, log in pairs if log}):
        expected = together.get((main, log), alone[main])
        put(path, main, log)
        before = contents(path.parent)
        assert_same(load(path), expected)
        assert contents(path.parent).items() >= before.items()
        with MapStore.open(path) as store:
            assert_same(store.load(), expected)
        assert_same(load(path), expected)
        assert check_map(path) == []
        aside = path.with_name(f"{log_of(path).name}.1")
        assert aside.exists() == ((main, log) not in together)
        assert not aside.exists() or aside.read_bytes() == log


def test_a_log_of_which_any_part_has_been_brought_over_is_still_taken_in(path):
    new_map(path)
    in_a_child(add_and_die, path, 5000, 1000 * PAGE)
    main, log = path.read_bytes(), log_of(path).read_bytes()
    expected = load(path)
    newest = pages_of(log)
    assert max(newest) > len(main) // PAGE
    for count in range(len(newest) + 1):  # in their order, as SQLite does
        done = bytearray(main)
        for number in sorted(newest)[:count]:
            done[(number - 1) * PAGE : number * PAGE] = newest[number]
        put(path, bytes(done), log)
        assert_same(load(path), expected)
        MapStore.open(path).close()
        assert_same(load(path), expected)
        assert [p.name for p in path.parent.iterdir()] == [path.name]


def pages_of(log):
    """Return the newest content of each page in a log by its number."""
    frames = range(32, len(log), PAGE + 24)
    return {int.from_bytes(log[i : i + 4]): log[i + 24 : i + 24 + PAGE] for i in frames}


def test_a_deleted_session_does_not_come_back_with_a_backup(path, caplog):
    new_map(path)
    backup = path.read_bytes()
    in_a_child(write_and_die, path)
    assert len(load(path).sessions) == 2
    path.write_bytes(backup)
    with caplog.at_level(logging.WARNING):
        assert len(load(path).sessions) == 1
    assert f"{path} is read without place.map-wal, which is not of this map" in caplog.text
    with caplog.at_level(logging.WARNING), MapStore.open(path) as store:
        assert len(store.load().sessions) == 1
        store.write(drive(5))
    assert f"{log_of(path)} is not of this map: set aside as place.map-wal.1" in caplog.text
    assert load(path).next_keyframe == 6
    assert {p.name for p in path.parent.iterdir()} == {path.name, "place.map-wal.1"}


@pytest.mark.parametrize("name", ["place.map-wal", "place.map-journal"])
def test_a_new_map_takes_nothing_of_what_lay_there(path, name):
    leftover = path.with_name(name)
    new_map(path)
    in_a_child(write_and_die, path)
    log_of(path).rename(leftover)
    path.unlink()
    new_store(path).close()
    assert load(path).sessions == []
    assert check_map(path) == []


@pytest.mark.parametrize("content", [b"", b"\0" * 5000, b"text " * 30_000])
def test_what_is_no_log_is_no_hindrance(path, content):
    new_map(path)
    expected = load(path)
    log_of(path).write_bytes(content)
    assert_same(load(path), expected)
    assert log_of(path).read_bytes() == content
    MapStore.open(path).close()
    assert_same(load(path), expected)
    assert path.with_name("place.map-wal.1").exists() == bool(content)


def hot_journal(path):
    """Return what SQLite puts beside a map as it is about to change page 1."""
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.execute("PRAGMA cache_size = 1")
        db.execute("BEGIN IMMEDIATE")
        db.execute("PRAGMA user_version = 3")
        db.execute("UPDATE features SET points = randomblob(20000)")
        journal = path.with_name("place.map-journal").read_bytes()
        db.execute("ROLLBACK")
    return journal


def test_a_journal_of_another_map_is_not_rolled_back_into_this_one(path, caplog):
    new_map(path, 2)
    journal = hot_journal(path)
    path.unlink()
    new_map(path, 5)
    expected, main = load(path), path.read_bytes()
    path.with_name("place.map-journal").write_bytes(journal)
    assert_same(load(path), expected)
    assert "read without place.map-journal" in caplog.text
    with MapStore.open(path) as store:
        assert_same(store.load(), expected)
    assert path.with_name("place.map-journal.1").read_bytes() == journal
    assert check_map(path) == []
    assert len(path.read_bytes()) == len(main)


@pytest.mark.parametrize("is_restored", [False, True])
def test_a_map_of_an_older_format_takes_in_a_log_unless_it_was_at_rest(path, is_restored):
    """Its log doesn't name it, but the file says whether a writer was at work."""
    new_map(path)
    make_older(path, 2)
    backup = path.read_bytes()
    in_a_child(write_as_of_old, path)
    if is_restored:
        path.write_bytes(backup)
    sessions = 1 if is_restored else 2
    assert len(load(path).sessions) == sessions
    MapStore.open(path).close()
    assert len(load(path).sessions) == sessions
    assert check_map(path) == []


def write_as_of_old(path):
    db = sqlite3.connect(path, isolation_level=None)
    db.execute("PRAGMA locking_mode = EXCLUSIVE")
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("INSERT INTO sessions VALUES (1, 0, 'old', '', FALSE, FALSE)")
    os.kill(os.getpid(), signal.SIGKILL)


def test_no_page_keeps_the_name_of_an_older_generation(path):
    new_map(path)
    seen = []
    with MapStore.open(path) as store:
        for i in range(5, 15):
            map_log.begin_log(store._connection)
            store.write(drive(i))
            seen += store._connection.execute("SELECT generation, parent FROM map").fetchall()
    (*older, _, _) = dict.fromkeys(name for pair in seen for name in reversed(pair))
    content = path.read_bytes()
    assert len(older) == 9
    assert not any(name.encode() in content for name in older)


def test_what_a_failed_transaction_wrote_takes_no_space(path):
    new_map(path)
    with MapStore.open(path) as store:
        store.write(drive(5))
        committed, expected = log_of(path).stat().st_size, store.load()
        db = store._connection
        db.execute("PRAGMA cache_size = 1")
        db.execute("BEGIN")
        db.execute("UPDATE features SET points = randomblob(100000)")
        db.execute("ROLLBACK")
        assert log_of(path).stat().st_size > committed + 100_000
        store.release_space()
        assert log_of(path).stat().st_size == committed
        assert_same(store.load(), expected)
        store.write(drive(6))
    assert load(path).next_keyframe == 7
    assert check_map(path) == []


@pytest.mark.slow
def test_kills_copies_and_backups_never_mix(path):
    """A user kills runs and puts maps back at random; each map has what it had when it was copied."""
    chance = random.Random(0)
    new_map(path, 2)
    copies = [(path.read_bytes(), load(path))]
    for _ in range(100):
        child = multiprocessing.get_context("fork").Process(
            target=chance.choice([open_and_close, add_and_die]), args=(path,)
        )
        child.start()
        child.join(chance.uniform(0.01, 0.1))
        child.kill()
        child.join()
        if chance.random() < 0.3:  # at rest
            MapStore.open(path).close()
            copies.append((path.read_bytes(), load(path)))
        if chance.random() < 0.3:
            main, expected = chance.choice(copies)
            path.write_bytes(main)
            assert_same(load(path), expected)
        assert check_map(path) == []
