"""Drawings that other programs can read, whatever robots are called."""

import re
from itertools import combinations
from xml.etree import ElementTree

import pytest
from mesh_answers import broker, conflict, full, mesh, robot

from psiu_broker.cli import graph
from psiu_broker.cli.mesh_view import View, composed

SVG = "{http://www.w3.org/2000/svg}"
HOSTILE = [
    '"]; x -- y [label="',
    "a\\",
    "<script>&amp;</script>",
    "two\nlines\x1b[31m",
    "\\N \\G",
    "]]>",
    "ROBÔ 机器人",
]


def parsed(view: View) -> ElementTree.Element:
    return ElementTree.fromstring(graph.svg(view))


def texts(drawing: ElementTree.Element) -> list[str]:
    return [each.text or "" for each in drawing.iter(f"{SVG}text")]


def lines(drawing: ElementTree.Element) -> list[ElementTree.Element]:
    return [each for each in drawing.iter(f"{SVG}line") if each.get("class") == "link"]


def strings(dot: str) -> tuple[list[str], str]:
    """The strings of a DOT file, as Graphviz reads them, and what is left without them."""
    quoted = re.compile(r'"((?:\\.|[^"\\])*)"')
    return quoted.findall(dot), quoted.sub("", dot)


def test_the_svg_has_every_broker_robot_and_round_trip_time() -> None:
    view = composed(full("base", "north", "gate", robots=[robot("MNERIM", "base"), robot("BRACO", "north")]))
    shown = texts(parsed(view))
    for words in ("base", "north", "gate", "MNERIM", "BRACO", "radio", "psiu mesh: 3 brokers, 2 robots"):
        assert words in shown
    assert shown.count("0.50 ms") == 3
    assert len(lines(parsed(view))) == 3


def test_a_relayed_pair_is_dashed_and_a_one_sided_one_red() -> None:
    direct, relayed = (
        parsed(composed([mesh("a", broker("b", linked=linked)), mesh("b", broker("a", linked=linked))]))
        for linked in (True, False)
    )
    assert lines(direct)[0].get("stroke-dasharray") is None
    assert lines(relayed)[0].get("stroke-dasharray") is not None
    (half,) = lines(parsed(composed([mesh("a"), mesh("b", broker("a"))])))
    assert half.get("stroke") != lines(direct)[0].get("stroke")


def test_a_conflict_and_losses_are_told() -> None:
    told = full("a", "b", robots=[robot("BETA", "a")], conflicts=[conflict("BETA", "a", "b")])
    told[0].brokers[0].lost = 4
    view = composed(told)
    assert "0.50 ms, 4 lost" in texts(parsed(view))
    assert ": a conflict" in graph.svg(view)
    assert "fontcolor" in graph.dot(view)


@pytest.mark.parametrize(("brokers", "robots"), [(1, 3), (2, 9), (5, 4), (12, 9), (50, 20)])
def test_nothing_is_drawn_over_a_broker_or_a_robot(brokers: int, robots: int) -> None:
    names = [f"b{index}" for index in range(brokers)]
    view = composed(full(*names, robots=[robot(f"R{n}-{m}", n) for n in names for m in range(robots)]))
    boxes = [
        tuple(float(str(each.get(side))) for side in ("x", "y", "width", "height"))
        for each in parsed(view).iter(f"{SVG}rect")
        if each.get("class") in ("broker", "robots")
    ]
    assert len(boxes) == 2 * brokers
    for (x, y, w, h), (x2, y2, w2, h2) in combinations(boxes, 2):
        assert x + w <= x2 or x2 + w2 <= x or y + h <= y2 or y2 + h2 <= y


@pytest.mark.parametrize("name", HOSTILE)
def test_no_name_can_break_the_svg(name: str) -> None:
    view = composed(full(name, "base", robots=[robot(name, "base", link=name)]))
    drawing = parsed(view)
    assert {each.tag for each in drawing.iter()} <= {
        SVG + tag for tag in ("svg", "title", "rect", "text", "line", "g", "circle")
    }
    assert len(lines(drawing)) == 1


@pytest.mark.parametrize("name", HOSTILE)
def test_no_name_can_break_the_dot(name: str) -> None:
    dot = graph.dot(composed(full(name, "base", robots=[robot(name, "base", link=name)])))
    plain = graph.dot(composed(full("a", "base", robots=[robot("BETA", "base")])))
    assert len(dot.splitlines()) == len(plain.splitlines())
    assert re.sub(r"b\d", "b", strings(dot)[1]) == re.sub(r"b\d", "b", strings(plain)[1])
    for each in strings(dot)[0]:
        # Backslashes come in pairs, or break our own lines.
        assert re.fullmatch(r'(?:[^"\\&]|\\\\|\\"|\\n|&amp;)*', each)


def test_a_long_name_is_cut_short_in_the_drawing_only() -> None:
    drawing = parsed(composed(full("x" * 200)))
    assert "x" * 27 + "…" in texts(drawing)
    assert "x" * 200 in [each.text for each in drawing.iter(f"{SVG}title")]
