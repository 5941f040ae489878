"""Small tables for notebooks: what `_repr_html_` of the package's classes returns."""

from collections.abc import Sequence
from html import escape

MOST_ROWS = 30  # of a table: what is more is counted


def html_table(title: str, heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return an HTML table, whatever stands in its cells escaped; of many rows the first ones, and how many more there are.

    Args:
        title: what stands above.
        heads: the names of the columns; none: the first column names its row.
        rows: the cells, row by row.
    """
    head = "".join(f"<th>{escape(name)}</th>" for name in heads)
    body = "".join(
        f"<tr>{''.join(_cell(cell, not heads and k == 0) for k, cell in enumerate(row))}</tr>" for row in rows[:MOST_ROWS]
    )
    if len(rows) > MOST_ROWS:
        body += f'<tr><td colspan="{len(heads) or len(rows[0])}">and {len(rows) - MOST_ROWS} more</td></tr>'
    top = f"<thead><tr>{head}</tr></thead>" if heads else ""
    return f"<table><caption>{escape(title)}</caption>{top}<tbody>{body}</tbody></table>"


def _cell(value: object, is_head: bool) -> str:
    text = escape(str(value))
    return f'<th style="text-align: left">{text}</th>' if is_head else f'<td style="text-align: left">{text}</td>'
