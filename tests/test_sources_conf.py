"""The scenario files of the sources build what they name."""

from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from sources_support import sweeps, write_bag

from lifelong_slam.config import build
from lifelong_slam.errors import ConfigError, SourceError

SCENARIOS = Path(__file__).parent.parent / "conf" / "scenario"


def scenario(name, **values):
    return OmegaConf.merge(OmegaConf.load(SCENARIOS / f"{name}.yaml"), values)


def test_bag(tmp_path):
    path = write_bag(tmp_path, "mcap", sweeps("mcap", 3))
    assert len(build(scenario("bag", path=str(path), topic="/lidar"))) == 3


def test_folder(tmp_path):
    np.ones((5, 4), np.float32).tofile(tmp_path / "0.bin")
    assert len(build(scenario("folder", path=str(tmp_path)))) == 1


@pytest.mark.parametrize("sequence", ["00", 0])
def test_kitti(tmp_path, sequence):
    scans = tmp_path / "sequences" / "00" / "velodyne"
    scans.mkdir(parents=True)
    np.ones((5, 4), np.float32).tofile(scans / "000000.bin")
    assert len(build(scenario("kitti", path=str(tmp_path), sequence=sequence))) == 1


def test_kiss_dataset(tmp_path):
    with pytest.raises(SourceError, match="no loader 'mulram'"):
        build(scenario("kiss_dataset", loader="mulram", path=str(tmp_path)))


@pytest.mark.parametrize("name", ["bag", "folder", "kitti", "kiss_dataset"])
def test_path_is_needed_and_misspelt_keys_are_named(name, tmp_path):
    with pytest.raises(ConfigError, match="path"):
        build(scenario(name, **({"loader": "ncd"} if name == "kiss_dataset" else {})))
    with pytest.raises(ConfigError, match=r"no setting 'pth'.*Did you mean 'path'"):
        build(scenario(name, path=str(tmp_path), pth="x", loader="ncd"))
