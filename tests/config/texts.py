"""Tables of a configuration, to be put together."""

AS_IN_THE_README = """
    [broker]
    name = "base"
    [zenoh]
    listen = ["tcp/127.0.0.1:7447"]
    [links.radio]
    adapter = "serial"
    device = "/dev/serial/by-id/usb-FTDI_FT232R-if00-port0"
    baudrate = 9600
    protocol = "psiu-ascii"
    [links.wifi]
    adapter = "udp"
    listen = "127.0.0.1:9000"
    peers = ["127.0.0.1:9001"]
    protocol = "psiu-ascii"
    [links.arm]
    adapter = "rfcomm"
    address = "98:D3:31:00:00:01"
    protocol = "psiu-hexa"
    topology = "point-to-point"
    [robots.BRACO]
    address = 0x12
    link = "arm"
    nodes.garra = { node = 4, type = "servo" }
"""
BROKER = """
    [broker]
    name = "base"
"""
RADIO = """
    [links.radio]
    adapter = "serial"
    device = "/dev/serial/by-id/radio"
    protocol = "psiu-ascii"
"""
HEXA = """
    [links.hexa]
    adapter = "serial"
    device = "/dev/serial/by-id/hexa"
    protocol = "psiu-hexa"
"""
CORPO = """
    [links.corpo]
    adapter = "serial"
    device = "/dev/serial/by-id/corpo"
    protocol = "mitya"
"""
CAMPO = """
    [links.campo]
    adapter = "serial"
    device = "/dev/serial/by-id/campo"
    baudrate = 19200
    protocol = "soccer"
"""
ARM = HEXA.replace("links.hexa", "links.arm").replace("by-id/hexa", "by-id/arm") + 'topology = "point-to-point"\n'
WIFI = """
    [links.wifi]
    adapter = "udp"
    listen = "127.0.0.1:9000"
    protocol = "psiu-ascii"
"""
PHONES = """
    [links.phones]
    adapter = "rfcomm"
    accept = true
    protocol = "psiu-ascii"
"""
HILL = """
    [trunks.hill]
    adapter = "rfcomm"
    address = "98:D3:31:00:00:01"
"""
VALLEY = """
    [trunks.valley]
    adapter = "serial"
    device = "socket://127.0.0.1:4000"
"""
ROBOT_WIFI = WIFI.replace("psiu-ascii", "psiu-hexa") + 'topology = "point-to-point"\nremote = 3\n'
