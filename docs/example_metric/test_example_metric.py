"""What a metric must pass; run with `pytest` in this folder."""

from example_metric import Acceleration

from eval.testing import check_metric


def test_acceleration_keeps_the_contract() -> None:
    """With its default settings and with others."""
    check_metric(Acceleration())
    check_metric(Acceleration(percentile=50.0))
