from psiu_broker.codecs.directories import Directories
from psiu_broker.frame import Address

ARM = (Address.named("MEU BRACO"), Address.numbered(0x12, "red"))


def test_a_codec_sees_robots_come_and_go_in_the_directory_it_was_given() -> None:
    directories = Directories()
    red, none = directories.of("red"), directories.of("")
    directories.add(ARM)
    assert (red.numbers, none.names) == ({0x12}, {"MEU BRACO"})
    directories.remove(ARM)
    assert (red.numbers, none.names) == (set(), set())


def test_only_names_with_spaces_are_listed() -> None:
    directories = Directories()
    directories.add([Address.named("BETA")])
    assert directories.of("").names == set()


def test_a_domain_knows_nothing_of_anothers_numbers() -> None:
    directories = Directories()
    directories.add(ARM)
    assert directories.of("blue").numbers == set()
    assert directories.of("red") is directories.of("red")
