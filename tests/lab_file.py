"""The configuration of a broker between MNERIM on a serial port, BETA on UDP and BRACO on a second serial port."""

from pathlib import Path


def lab_text(
    *, bus: int, radio: str | Path, wifi: int, arm: str | Path, beta: int | None = None, timeout_s: float = 2.0
) -> str:
    """Robots on serial ports have `timeout_s` to answer; `beta` is BETA's UDP port where the broker knows it."""
    peers = "" if beta is None else f'peers = ["127.0.0.1:{beta}"]'
    return f"""
[broker]
name = "base"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[links.radio]
adapter = "serial"
device = "{radio}"
baudrate = 115200
protocol = "psiu-ascii"
timeout_s = {timeout_s}
[links.wifi]
adapter = "udp"
listen = "127.0.0.1:{wifi}"
{peers}
protocol = "psiu-ascii"
[links.arm]
adapter = "serial"
device = "{arm}"
baudrate = 115200
protocol = "psiu-hexa"
topology = "point-to-point"
timeout_s = {timeout_s}
[robots.BRACO]
address = 0x12
link = "arm"
nodes.garra = {{ node = 4, type = "servo" }}
nodes.sonar = {{ node = 7, type = "distance", unit = "cm" }}
"""
