"""Robots of each protocol as somebody would configure them, what they are asked, and what programs play with."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from psiu_broker.messages import Value

ROBOTS: Final[Mapping[str, dict[str, Any]]] = {
    "psiu-ascii": {"commands": {"garra": {"ints": 1, "minimum": 0, "maximum": 90, "unit": "deg"}}},
    "psiu-hexa": {"nodes": {"garra": {"node": 1, "type": "servo"}, "luz": {"node": 2, "type": "luminosity"}}},
    "mitya": {"commands": {"marcha": {"letter": "L", "minimum": -100, "maximum": 100, "unit": "%", "scale": 2.55}}},
    "soccer": {},
    "firmata": {
        "pins": {
            "farol": {"pin": 13, "mode": "output"},
            "toque": {"pin": 2, "mode": "pullup"},
            "roda": {"pin": 3, "mode": "pwm", "unit": "%"},
            "garra": {"pin": 9, "mode": "servo", "pulses_us": [600, 2300]},
            "luz": {"pin": "A0", "mode": "analog", "scale": 0.1, "unit": "lx"},
        }
    },
    "amarino": {
        "commands": {"temperatura": {"flag": "t", "answer": True, "unit": "C"}, "brilho": {"flag": "b"}},
        "readings": [{"name": "x", "unit": "g"}, {"name": "y", "unit": "g"}],
    },
}
"""What ``[robots.NAME]`` holds."""

CALLS: Final[Mapping[str, Sequence[tuple[str, Sequence[Value]]]]] = {
    "psiu-ascii": [("quantoscomandos", []), ("exibecomando", [1]), ("qualseunome", []), ("parafrente", [100])],
    "psiu-hexa": [("ping", []), ("garra", [45]), ("luz", []), ("node", [3, 1]), ("complex", ["0xa1b2"])],
    "mitya": [("marcha", [50]), ("nod", []), ("battery", []), ("roboscript-abort", []), ("play", [1])],
    "soccer": [("pare", [])],
    "firmata": [("farol", [1]), ("toque", []), ("roda", [50]), ("luz", []), ("mode", [9, "servo"]), ("reset", [])],
    "amarino": [("temperatura", []), ("brilho", []), ("send", ["a", 1])],
}
"""What their answers are awaited to; a robot of another version may refuse some."""

MAPS: Final[Mapping[str, dict[str, Any]]] = {
    "mitya": {
        "drive": {"command": "parafrente", "below_zero": "paratras", "at_zero": "pare", "scale": 0.4, "maximum": 90},
        "head-horizontal": {"command": "garra", "scale": 1, "offset": -90},
        "nod": {"command": "acena"},
        "script": {"command": "toca", "scale": 1},
    },
    "firmata": {
        "2": {"reading": "toque"},
        "3": {"command": "roda", "mode": "pwm", "scale": 0.5},
        "9": {"command": "garra", "mode": "servo", "offset": -90, "minimum": -45, "maximum": 45},
        "13": {"command": "farol"},
        "A0": {"reading": "luz", "scale": 10, "poll_s": 0.5},
    },
    "amarino": {
        "A": {"command": "parafrente", "scale": 100, "maximum": 300, "stream": True},
        "f": {"command": "fala", "as_it_is": True},
        "p": {"command": "pare"},
    },
}
"""What ``[links.NAME.map]`` holds where a program plays with such a robot."""
