"""Run folders as `scripts/run.py` leaves them, with figures and maps that are known."""

import json

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from omegaconf import OmegaConf
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

DEFAULTS = {"scenario": "E", "sensor": "bosch", "pruning": "geometry", "system": "lifelong"}
IDENTITY = Rotation.identity()


def write_run(folder, overrides=(), trajectory=None, number=0, **sections):
    """Write a run folder; `trajectory` and other sections are those of metrics.json."""
    given = dict(line.split("=", 1) for line in overrides)
    choices = {**DEFAULTS, **{k: v for k, v in given.items() if k in DEFAULTS}, "hydra/output": "x"}
    hydra = folder / ".hydra"
    hydra.mkdir(parents=True)
    OmegaConf.save(OmegaConf.create([*overrides]), hydra / "overrides.yaml")
    OmegaConf.save(
        OmegaConf.create({"hydra": {"job": {"num": number}, "runtime": {"choices": choices}}}),
        hydra / "hydra.yaml",
    )
    config = OmegaConf.create({"seed": 0, "scenario": {"seed": 0, "laps": 1}})
    for key, value in given.items():
        if key not in choices:
            OmegaConf.update(config, key, int(value) if value.isdecimal() else value)
    OmegaConf.save(config, hydra / "config.yaml")
    metrics = {"trajectory": trajectory or {}, "run": {"interrupted": False}, **sections}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def errors(mae, largest=None, alignment=None):
    """Return section `trajectory` with errors in metres."""
    return {
        "mae_m": mae,
        "max_m": 2 * mae if largest is None else largest,
        "mse_m2": mae**2,
        "alignment": alignment,
    }


def headlined(section, **headlines):
    """Return a section with headlines by metric: title, value, unit, and whether less is better."""
    names = ("title", "value", "unit", "less_is_better")
    found = {name: dict(zip(names, told, strict=True)) for name, told in headlines.items()}
    return {**section, "headlines": found}


def aligned(method, rotation=IDENTITY, shift=(0.0, 0.0, 0.0), scale=1.0):
    """Return an alignment as metrics.json holds it."""
    return {
        "method": method,
        "rotation": rotation.as_matrix().tolist(),
        "translation_m": [*shift],
        "scale": scale,
    }


def write_map(folder, points):
    """Write (N, 3) points as the map of a run."""
    rows = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    vertices = np.zeros(len(rows), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    for axis, column in zip("xyz", rows.T, strict=True):
        vertices[axis] = column
    PlyData([PlyElement.describe(vertices, "vertex")]).write(folder / "map.ply")


def write_trajectories(folder, reference, rotation=IDENTITY, shift=(0.0, 0.0, 0.0)):
    """Write (N, 3) reference positions, and an estimate in a frame that is turned and shifted.

    The alignment that brings the estimate back is ``p -> rotation p + shift``.
    """
    stamps = np.arange(len(reference), dtype=float)
    for name, turn, positions in (
        ("reference", IDENTITY, reference),
        ("trajectory", rotation.inv(), rotation.inv().apply(reference - np.array(shift))),
    ):
        wxyz = np.tile(np.roll(turn.as_quat(), 1), (len(reference), 1))
        path = PoseTrajectory3D(positions, wxyz, stamps)
        file_interface.write_tum_trajectory_file(str(folder / f"{name}.tum"), path)
