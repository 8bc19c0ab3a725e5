import pytest
from omegaconf import OmegaConf

from lifelong_slam.config import build
from lifelong_slam.errors import ConfigError, SourceError


class Thing:
    def __init__(
        self, size: float, name: str = "x", parts: dict[str, float] | None = None, on: bool = True
    ):
        if size < 0:
            raise SourceError("too small")
        self.size, self.name, self.parts, self.on = size, name, parts, on


class Holder:
    def __init__(self, thing: Thing):
        self.thing = thing


class Broken:
    def __init__(self):
        raise ZeroDivisionError


def make(**settings):
    kind = settings.pop("kind", "Thing")
    return build(OmegaConf.create({"_target_": f"{__name__}.{kind}", **settings}))


def test_builds_with_values_converted():
    thing = make(size="0.5", name=2011, parts={"a": 1}, on="false")
    assert (thing.size, thing.name, thing.parts, thing.on) == (0.5, "2011", {"a": 1.0}, False)


def test_builds_what_is_nested():
    nested = {"_target_": f"{__name__}.Thing", "size": 2}
    assert make(kind="Holder", thing=nested).thing.size == 2.0
    with pytest.raises(ConfigError, match="Did you mean 'size'"):
        make(kind="Holder", thing={**nested, "sise": 2})


def test_resolves_references():
    config = OmegaConf.create({"a": 3, "t": {"_target_": f"{__name__}.Thing", "size": "${a}"}})
    assert build(config.t).size == 3.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": 1, "nam": "y"}, "has no setting 'nam'. Did you mean 'name'"),
        ({"size": "big"}, "Thing: size: .*number.* got 'big'"),
        ({"size": 1, "on": 7}, "Thing: on: .*boolean"),
        ({"size": 1, "parts": {"a": "x"}}, "Thing: parts: .*number"),
        ({"name": "y"}, "Thing needs a value for: size"),
        ({"size": "???"}, "size has no value"),
        ({"size": "${nowhere}"}, "nowhere"),
        ({"kind": "Nothing"}, "can't be loaded"),
        ({"_target_": "no.such.module"}, "can't be loaded"),
    ],
)
def test_errors_are_one_line_that_names_the_setting(settings, message):
    with pytest.raises(ConfigError, match=message) as caught:
        make(**settings)
    assert "\n" not in str(caught.value)


def test_errors_of_the_target_pass_as_they_are():
    with pytest.raises(SourceError, match="too small"):
        make(size=-1)
    with pytest.raises(ZeroDivisionError):
        make(kind="Broken")
