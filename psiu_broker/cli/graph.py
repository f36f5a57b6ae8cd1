"""The mesh as a drawing: Graphviz DOT, and SVG that needs no other program. Pure."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import combinations
from math import cos, inf, pi, sin
from typing import Final
from unicodedata import east_asian_width

from psiu_broker.cli.mesh_view import Broker, Pair, Robot, View
from psiu_broker.cli.output import ago, milliseconds, printable

_NAME_MAX: Final = 28
_COLUMN: Final = 8
"""Robots one below the other, before the next column begins."""
_PILL_H: Final = 24.0
_GAP: Final = 6.0
_APART: Final = 16.0
"""Between the boxes of two brokers, at least."""
_MARGIN: Final = 24.0
_PLACES: Final = (0.5, 0.42, 0.58, 0.34, 0.66, 0.26, 0.74, 0.2, 0.8)
"""Where on an edge its label may stand."""
_CLEAR: Final = 20
"""Edges that may be drawn thick."""

_INK, _GREY, _PALE, _RED, _AMBER, _BLUE = "#1f2328", "#6e7781", "#d0d7de", "#cf222e", "#9a6700", "#0969da"


def dot(view: View) -> str:
    """The mesh in the DOT language: ``psiu mesh --graph | dot -Tpng -o mesh.png``."""
    ids = {broker.name: f"b{index}" for index, broker in enumerate(view.brokers)}
    lines = [
        "graph psiu {",
        '  layout=neato; overlap=false; splines=true; node [fontname="sans-serif"]; edge [fontname="sans-serif"];',
    ]
    for broker in view.brokers:
        style = "rounded" if broker.answers else "rounded,dashed"
        lines.append(f'  {ids[broker.name]} [label={_quoted(broker.name, _said(broker))}, shape=box, style="{style}"];')
    for pair in view.pairs:
        style = "solid" if pair.direct else "dashed"
        colour = f', color="{_RED}"' if pair.only is not None else ""
        ends = f"{ids[pair.a]} -- {ids[pair.b]}"
        lines.append(f"  {ends} [label={_quoted(_edge_words(pair))}, style={style}, len=3{colour}];")
    for index, robot in enumerate(view.robots):
        colour = f', fontcolor="{_RED}"' if robot.told.robot in view.contested else ""
        lines.append(f"  r{index} [label={_quoted(_robot_words(robot), robot.told.link)}, shape=plaintext{colour}];")
        lines.append(f"  {ids[robot.told.owner]} -- r{index} [style=dotted];")
    return "\n".join([*lines, "}", ""])


def svg(view: View) -> str:
    """The mesh as an SVG file: brokers on a circle, times on the lines between them, robots beside their owner."""
    placed = _placed(view)
    boxes = [box for each in placed.values() for box in each.boxes]
    drawn = [
        *_edges(view.pairs, placed),
        *(line for broker in view.brokers for line in _node(broker, placed[broker.name], view.contested)),
    ]
    left, top = min(box.left for box in boxes) - _MARGIN, min(box.top for box in boxes) - _MARGIN - 44
    title, legend = _heading(view), _legend(view)
    right = max(*(box.right for box in boxes), left + max(_width(title, 13), _width(legend, 11)) + _MARGIN)
    bottom = max(box.bottom for box in boxes) + 40
    width, height = right - left + _MARGIN, bottom - top
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}"'
        f' viewBox="{left:.1f} {top:.1f} {width:.1f} {height:.1f}"'
        " font-family=\"system-ui, 'DejaVu Sans', sans-serif\">"
    )
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            head,
            f"<title>{_escaped(title)}</title>",
            f'<rect x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" height="{height:.1f}" fill="#ffffff"/>',
            _text(left + _MARGIN, top + 32, title, 13, fill=_GREY, anchor="start"),
            *drawn,
            _text(left + _MARGIN, bottom - 14, legend, 11, fill=_GREY, anchor="start"),
            "</svg>",
            "",
        ]
    )


@dataclass(frozen=True)
class _Box:
    """A rectangle by its middle and half its sides."""

    x: float
    y: float
    w: float
    h: float

    @property
    def left(self) -> float:
        return self.x - self.w

    @property
    def right(self) -> float:
        return self.x + self.w

    @property
    def top(self) -> float:
        return self.y - self.h

    @property
    def bottom(self) -> float:
        return self.y + self.h

    def overlap(self, other: "_Box", apart: float = 0.0) -> bool:
        return abs(self.x - other.x) < self.w + other.w + apart and abs(self.y - other.y) < self.h + other.h + apart


@dataclass(frozen=True)
class _Placed:
    """A broker's box and the panel of its robots, which is outside of the circle."""

    box: _Box
    panel: _Box | None
    robots: tuple[Robot, ...]
    column_w: float

    @property
    def boxes(self) -> tuple[_Box, ...]:
        return (self.box,) if self.panel is None else (self.box, self.panel)


def _placed(view: View) -> dict[str, _Placed]:
    """Every broker with its robots on a circle that is just large enough for all."""
    radius = 0.0 if len(view.brokers) == 1 else 150.0
    while True:
        placed = {broker.name: _place(view, index, radius) for index, broker in enumerate(view.brokers)}
        if not any(
            mine.overlap(its, _APART)
            for one, other in combinations(placed.values(), 2)
            for mine in one.boxes
            for its in other.boxes
        ):
            return placed
        radius *= 1.1


def _place(view: View, index: int, radius: float) -> _Placed:
    broker = view.brokers[index]
    count = len(view.brokers)
    # One broker stands above its robots, two side by side, more begin at the top.
    angle = {1: pi / 2, 2: pi + index * pi}.get(count, -pi / 2 + 2 * pi * index / count)
    across, down = cos(angle), sin(angle)
    half_w = max(_width(_short(broker.name), 15), _width(_said(broker), 11), 70) / 2 + 14
    box = _Box(radius * across * 1.15, radius * down, half_w, 24)
    robots = tuple(view.robots_of(broker.name))
    if not robots:
        return _Placed(box, None, (), 0)
    columns = -(-len(robots) // _COLUMN)
    rows = -(-len(robots) // columns)
    column_w = max(_width(_short(_robot_words(each)), 12) + _width(_short(each.told.link), 10) for each in robots) + 44
    w, h = (columns * (column_w + _GAP) + _GAP) / 2, (rows * (_PILL_H + _GAP) + _GAP) / 2
    away = min(
        (box.w + w + 22) / abs(across) if abs(across) > 0.01 else inf,
        (box.h + h + 22) / abs(down) if abs(down) > 0.01 else inf,
    )
    return _Placed(box, _Box(box.x + away * across, box.y + away * down, w, h), robots, column_w)


def _edges(pairs: Sequence[Pair], placed: dict[str, _Placed]) -> Iterator[str]:
    """The lines first, then their labels, trouble before times; a time for which there is no room is left out."""
    taken = [each.box for each in placed.values()]
    labels = []
    for pair in sorted(pairs, key=lambda pair: not (pair.lost or pair.only)):
        a, b = placed[pair.a].box, placed[pair.b].box
        colour = _RED if pair.only is not None else _GREY
        dash = "" if pair.direct and pair.only is None else ' stroke-dasharray="6 5"'
        yield (
            f'<line class="link" x1="{a.x:.1f}" y1="{a.y:.1f}" x2="{b.x:.1f}" y2="{b.y:.1f}" stroke="{colour}"'
            f' stroke-width="{1.6 if len(pairs) <= _CLEAR else 0.7}"{dash}>'
            f"<title>{_escaped(_edge_tip(pair))}</title></line>"
        )
        words = _edge_words(pair)
        w = _width(words, 11) / 2 + 5
        places = [_Box(a.x + (b.x - a.x) * part, a.y + (b.y - a.y) * part, w, 9) for part in _PLACES]
        anyway = places[0] if pair.lost or pair.only else None
        label = next((each for each in places if not any(each.overlap(other, 2) for other in taken)), anyway)
        if label is not None:
            taken.append(label)
            labels.append((label, words, _AMBER if pair.lost else colour))
    for label, words, colour in labels:
        yield _rect(label, 4, fill="#ffffff")
        yield _text(label.x, label.y + 4, words, 11, fill=colour)


def _node(broker: Broker, placed: _Placed, contested: frozenset[str]) -> Iterator[str]:
    box = placed.box
    if placed.panel is not None:
        panel = placed.panel
        yield (
            f'<line x1="{box.x:.1f}" y1="{box.y:.1f}" x2="{panel.x:.1f}" y2="{panel.y:.1f}" stroke="{_PALE}"'
            ' stroke-width="3"/>'
        )
        yield _rect(panel, 10, fill="#f6f8fa", stroke=_PALE, more=' class="robots"')
        rows = -(-len(placed.robots) // -(-len(placed.robots) // _COLUMN))
        for index, robot in enumerate(placed.robots):
            column, row = divmod(index, rows)
            left = panel.left + _GAP + column * (placed.column_w + _GAP)
            top = panel.top + _GAP + row * (_PILL_H + _GAP)
            pill = _Box(left + placed.column_w / 2, top + _PILL_H / 2, placed.column_w / 2, _PILL_H / 2)
            yield from _pill(robot, pill, contested=robot.told.robot in contested)
    colour, dash = (_BLUE, "") if broker.answers else (_GREY, ' stroke-dasharray="4 4"')
    if broker.name in contested:
        colour = _RED
    yield "<g>"
    yield f"<title>{_escaped(broker.name)}</title>"
    yield _rect(box, 12, fill="#ffffff", stroke=colour, more=f' class="broker" stroke-width="2"{dash}')
    yield _text(box.x, box.y - 1, _short(broker.name), 15, fill=_INK, more=' font-weight="600"')
    yield _text(box.x, box.y + 15, _said(broker), 11, fill=_GREY)
    yield "</g>"


def _pill(robot: Robot, box: _Box, *, contested: bool) -> Iterator[str]:
    told = robot.told
    heard = "never heard" if told.age_s is None else f"heard {ago(told.age_s)}"
    tip = f"{_robot_words(robot)}: {told.protocol} on {told.owner}/{told.link}, quality {told.quality:.0%}, {heard}"
    fill, stroke, ink = ("#ffebe9", _RED, _RED) if contested else ("#ffffff", _PALE, _INK)
    yield "<g>"
    yield f"<title>{_escaped(tip + (': a conflict' if contested else ''))}</title>"
    yield _rect(box, box.h, fill=fill, stroke=stroke)
    yield f'<circle cx="{box.left + 13:.1f}" cy="{box.y:.1f}" r="4" fill="{_quality_colour(told.quality)}"/>'
    yield _text(box.left + 23, box.y + 4, _short(_robot_words(robot)), 12, fill=ink, anchor="start")
    yield _text(box.right - 11, box.y + 4, _short(told.link), 10, fill=_GREY, anchor="end")
    yield "</g>"


def _quality_colour(quality: float) -> str:
    """Green for a robot that is heard well, red for one that is hardly heard."""
    return f"hsl({max(0.0, min(1.0, quality)) * 130:.0f}, 65%, 42%)"


def _heading(view: View) -> str:
    counts = [
        _count(len(view.brokers), "broker"),
        _count(len(view.robots), "robot"),
        *([_count(len(view.conflicts), "conflict")] if view.conflicts else []),
    ]
    return f"psiu mesh: {', '.join(counts)}"


def _legend(view: View) -> str:
    words = ["times are there and back", "a robot's dot is how well it is heard"]
    if any(not pair.direct for pair in view.pairs):
        words.append("dashed: others relay")
    if view.conflicts:
        words.append("red: a conflict")
    return "; ".join(words)


def _said(broker: Broker) -> str:
    return _count(broker.robots, "robot") if broker.answers else "does not answer"


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _edge_words(pair: Pair) -> str:
    words = [] if pair.rtt_ms is None else [milliseconds(pair.rtt_ms)]
    if pair.lost:
        words.append(f"{pair.lost} lost")
    return ", ".join(words) or pair.how


def _edge_tip(pair: Pair) -> str:
    return f"{pair.a} – {pair.b}: {pair.how}, frames → {pair.a_to_b}, ← {pair.b_to_a}, lost {pair.lost}"


def _robot_words(robot: Robot) -> str:
    told = robot.told
    return told.robot if told.address in (None, told.robot) else f"{told.robot} {told.address}"


def _short(text: str) -> str:
    text = printable(text)
    return text if len(text) <= _NAME_MAX else text[: _NAME_MAX - 1] + "…"


def _width(text: str, size: float) -> float:
    """About how wide `text` is drawn."""
    return size * sum(1.05 if east_asian_width(char) in "WF" else 0.62 for char in printable(text))


def _quoted(*lines: str) -> str:
    """A DOT string: no name can end it, and neither ``\\N`` nor ``&lt;`` in one means anything."""
    clean = (printable(line).replace("&", "&amp;").replace("\\", "\\\\").replace('"', '\\"') for line in lines)
    return '"' + "\\n".join(clean) + '"'


def _escaped(text: str) -> str:
    return escape(printable(text), quote=True)


def _text(x: float, y: float, text: str, size: float, *, fill: str, anchor: str = "middle", more: str = "") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{fill}" text-anchor="{anchor}"{more}>'
        f"{_escaped(text)}</text>"
    )


def _rect(box: _Box, round_: float, *, fill: str, stroke: str | None = None, more: str = "") -> str:
    line = f' stroke="{stroke}"' if stroke is not None else ""
    return (
        f'<rect x="{box.left:.1f}" y="{box.top:.1f}" width="{2 * box.w:.1f}" height="{2 * box.h:.1f}"'
        f' rx="{round_:g}" fill="{fill}"{line}{more}/>'
    )
