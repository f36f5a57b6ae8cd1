"""A broker for small robots: serial, Bluetooth and UDP links joined into one network on Zenoh."""

__version__ = "0.1.0"
