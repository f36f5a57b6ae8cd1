"""One form for a frame whatever link it was heard on, so that a double is known by its bytes."""

from collections.abc import Hashable, Mapping
from typing import Final

from psiu_broker.codecs.codec import Codec, Directory
from psiu_broker.codecs.psiu_ascii import PsiuAscii
from psiu_broker.codecs.psiu_hexa import PsiuHexa
from psiu_broker.errors import EncodeError
from psiu_broker.frame import Frame

_PLAIN: Final[Mapping[str, Codec]] = {
    codec.protocol: codec
    for codec in (PsiuAscii(PsiuAscii.Options(), Directory()), PsiuHexa(PsiuHexa.Options(), Directory()))
}
"""Each protocol in its most usual dialect, whose frames are their own identity."""
_PLAIN_DIALECTS: Final = frozenset(codec.dialect for codec in _PLAIN.values())


def identity(frame: Frame) -> Hashable:
    """Equal for two frames that say the same from one robot to another, in whatever dialect; never raises."""
    if frame.dialect in _PLAIN_DIALECTS:
        return frame.wire
    if not frame.source.domain and not frame.destination.domain:
        try:
            return _PLAIN[frame.protocol].encode(frame._replace(dialect="", wire=b""))
        except (EncodeError, KeyError):
            pass
    return frame.protocol, frame.source, frame.destination, frame.payload
