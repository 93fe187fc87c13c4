"""Pages of HTML that hold everything they show: style, tables and figures."""

import base64
from collections.abc import Iterable
from html import escape
from pathlib import Path


def render_page(title: str, body: Iterable[str]) -> str:
    """A page of these pieces of HTML; empty ones are left out."""
    return _PAGE.format(title=escape(title), style=_STYLE, body="\n".join(part for part in body if part))


def image_tag(title: str, path: Path, *, width: str = "full") -> str:
    """A PNG or JPEG file inside the page.

    Args:
        title: read out where the image cannot be seen.
        path: of the file.
        width: ``full``, ``large`` or ``half``.
    """
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    kind = "jpeg" if path.suffix == ".jpg" else "png"
    return f"<img class={width} alt='{escape(title, quote=True)}' src='data:image/{kind};base64,{data}'>"


_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #262626; background: #fff;
       max-width: 1180px; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.7rem; margin: 0 0 .2rem; }
h2 { font-size: 1.25rem; margin: 2.4rem 0 .6rem; border-bottom: 1px solid #ddd; padding-bottom: .25rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; margin: .5rem 0; }
th { font-weight: 600; text-align: right; vertical-align: bottom; padding: .25rem .6rem; }
thead th { border-bottom: 1.5px solid #888; }
th small { font-weight: 400; color: #777; }
td { text-align: right; padding: .16rem .6rem; border-bottom: 1px solid #eee; }
td.name, th.name, td.text { text-align: left; }
td.unit { text-align: left; color: #777; padding-left: 0; }
tr.final td { color: #a85a12; }
tr.final td.name { padding-left: 1.6rem; }
td.failed, td.interrupted { color: #b3202c; font-weight: 600; }
.undefined { color: #999; font-style: italic; font-size: .8rem; }
.columns { display: flex; flex-wrap: wrap; gap: .5rem 3.5rem; align-items: flex-start; }
.scroll { overflow-x: auto; }
.scroll td, .scroll th { padding-left: .4rem; padding-right: .4rem; }
.parts { color: #555; margin: 0 0 1rem; }
.failure { background: #fdecec; border-left: 4px solid #b3202c; padding: .5rem .8rem; }
.counters { background: #fff6e0; border-left: 4px solid #d9a441; padding: .4rem .8rem; }
h3 { font-size: 1.05rem; margin: 1.6rem 0 .3rem; }
li.bad { color: #b3202c; font-weight: 600; }
details ul { margin: .2rem 0; padding-left: 1.1rem; }
.note { color: #777; font-size: .86rem; margin: .3rem 0; }
img { width: 100%; display: block; margin: 1.2rem 0; }
img.large { width: 76%; margin: 1rem auto; }
img.half { width: 49.4%; display: inline-block; margin: .4rem 0; }
pre { background: #f6f6f6; padding: .8rem; overflow-x: auto; font-size: .84rem; }
summary { cursor: pointer; color: #1f6fb4; }
"""
_PAGE = """<!doctype html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{style}</style></head>
<body>
{body}
</body>
</html>
"""
