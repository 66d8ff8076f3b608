"""Markdown of a table."""

import pandas as pd


def markdown(table: pd.DataFrame) -> str:
    """A table with its column names as the header row."""
    rows = [list(table.columns), ["---"] * table.shape[1], *table.astype(str).to_numpy().tolist()]
    return "".join("| " + " | ".join(row) + " |\n" for row in rows)
