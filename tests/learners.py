"""Algorithms with their compiled updates, shared by the contract tests."""

from jaxsafe.algos import ALGOS
from jaxsafe.learn.on_policy import OnPolicyConfig


def on_policy_names(holds: str = "") -> list[str]:
    """The on-policy algorithms; with `holds` those whose row says so."""
    rows = {name: row for name, row in ALGOS.items() if issubclass(row.config, OnPolicyConfig)}
    return sorted(name for name, row in rows.items() if holds in ("", row.holds))
