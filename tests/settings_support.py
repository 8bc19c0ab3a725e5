"""The settings of conf/eval, as the scripts compose them."""

from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from eval.evaluation import make_settings

CONF = Path(__file__).resolve().parents[1] / "conf"


def default_settings(*overrides):
    """Return the settings of `python scripts/evaluate.py` with overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("evaluate", overrides=[*overrides])
    return make_settings(OmegaConf.to_container(config.eval, resolve=True))
