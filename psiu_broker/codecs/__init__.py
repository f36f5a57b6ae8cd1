"""Protocols as bytes: pure codecs, one file each."""
