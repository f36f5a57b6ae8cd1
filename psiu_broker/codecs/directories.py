"""A `Directory` for the codecs of each domain, kept as robots come and go."""

from collections.abc import Iterable

from psiu_broker.codecs.codec import Directory
from psiu_broker.frame import Address


class Directories:
    """One for each domain that was asked for or named; a codec keeps the one it was given."""

    def __init__(self) -> None:
        self._by_domain: dict[str, Directory] = {}

    def of(self, domain: str) -> Directory:
        directory = self._by_domain.get(domain)
        if directory is None:
            directory = self._by_domain[domain] = Directory()
        return directory

    def add(self, addresses: Iterable[Address]) -> None:
        """A robot came."""
        for address in addresses:
            directory = self.of(address.domain)
            if address.is_numbered:
                directory.numbers.add(address.number)
                continue
            directory.all_names.add(address.name)
            if " " in address.name:
                directory.names.add(address.name)

    def remove(self, addresses: Iterable[Address]) -> None:
        """A robot is gone."""
        for address in addresses:
            directory = self.of(address.domain)
            directory.names.discard(address.name)
            directory.all_names.discard(address.name)
            directory.numbers.discard(address.number)
