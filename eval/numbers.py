"""How figures are written for people."""


def number(value: float, digits: int = 4) -> str:
    """Write a figure with some significant digits, or all of those before the point."""
    return f"{value:,.0f}" if abs(value) >= 10 ** (digits - 1) else f"{value:.{digits}g}"
