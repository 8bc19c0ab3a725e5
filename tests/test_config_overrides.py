from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from lifelong_slam.errors import ConfigError
from lifelong_slam.overrides import check_overrides

CONF = Path(__file__).parent.parent / "conf"
SYSTEM = "system=kiss_icp"


@pytest.mark.parametrize(
    "overrides",
    [
        "seed=1",
        "scenario=A,B,C,D,E,F sensor=bosch,velodyne",
        "scenario=loop scenario.laps=2,3",
        "scenario=seasons scenario.session=1,2 sensor=vls128",
        "scenario=bag scenario.path=/some/file.bag",
        "scenario=glob([A-F])",
        "hydra.run.dir=/tmp/x hydra.verbose=true",
        "+scenario.laps=2",  # left to build, which knows what the scenario takes
        "~viewer",
    ],
)
def test_accepts(overrides):
    check_overrides(CONF, [SYSTEM, *overrides.split()])


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("scenaro=E", "no setting 'scenaro'. Did you mean 'scenario'"),
        ("scenario=loop scenario.lapps=2", "'scenario.lapps'. Did you mean 'laps'?.*scenario=loop"),
        ("scenario=Z", "scenario=Z: there is no such scenario.*Choices: A, B, C"),
        ("scenario=3", "scenario=3: there is no such scenario"),
        ("sensor=bosh", "Did you mean 'bosch'"),
        ("scenario=A,B,Q", "scenario=Q"),
        ("seed=1,2 sensor=bosch,velodine", "Did you mean 'velodyne'"),
        ("hydra.rn.dir=x", "Did you mean 'run'"),
        ("hydra/launcher=joblob", "Choices: basic"),
        ("+foo=1", "no setting 'foo'"),
        ("+sensor.max_rnge=3", "Did you mean 'max_range'"),
        ("+eval.metrcs.mine._target_=a.B", "Did you mean 'metrics'"),
        ("+system.odometry.motion.x.y=1", "no setting"),
        ("scenario/x=3", "no setting 'scenario/x'"),
        ("a=b=c", "'a=b=c' can't be read"),
        ("E", "'E' can't be read: write key=value"),
    ],
)
def test_refuses_in_one_line_that_names_what_is_right(overrides, message):
    with pytest.raises(ConfigError, match=message) as caught:
        check_overrides(CONF, [SYSTEM, *overrides.split()])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "overrides",
    [
        "+eval.metrics.mine._target_=my_package.Metric",
        "+eval.metrics.mine._target_=my_package.Metric +eval.metrics.mine.delta=3",
        "+eval.metrics.mine={_target_:my_package.Metric}",
        "+eval.metrics.mine._target_=my_package.Metric eval.metrics.speed=null",
    ],
)
def test_collections_of_targets_take_more_of_them(overrides):
    check_overrides(CONF, [SYSTEM, *overrides.split()])


def test_a_second_folder_of_configs_adds_choices(tmp_path):
    (tmp_path / "sensor").mkdir()
    (tmp_path / "sensor" / "mine.yaml").write_text("name: mine\n")
    with pytest.raises(ConfigError):
        check_overrides(CONF, [SYSTEM, "sensor=mine"])
    check_overrides(CONF, [SYSTEM, "sensor=mine"], more=tmp_path)
    with pytest.raises(ConfigError, match="Did you mean 'mine'"):
        check_overrides(CONF, [SYSTEM, "sensor=mien"], more=tmp_path)


@pytest.mark.parametrize("path", sorted(CONF.glob("sensor/*.yaml")), ids=lambda path: path.stem)
def test_sensors_have_what_the_systems_refer_to(path):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        sensor = compose("config", overrides=[SYSTEM, f"sensor={path.stem}"]).sensor
    assert set(sensor) >= {"name", "topic", "min_range", "max_range", "voxel_size"}
    assert sensor.name == path.stem
    assert 0 < sensor.min_range < sensor.max_range
