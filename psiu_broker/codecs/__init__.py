"""The protocols that the broker speaks, each a pure codec found by its name."""

from collections.abc import Mapping
from typing import Final

from psiu_broker.codecs.codec import Codec
from psiu_broker.codecs.psiu_ascii import PsiuAscii
from psiu_broker.codecs.psiu_hexa import PsiuHexa

CODECS: Final[Mapping[str, type[Codec]]] = {codec.protocol: codec for codec in (PsiuAscii, PsiuHexa)}
"""Every codec by the name that the user writes as ``protocol``."""
