from psiu_broker.codecs.avr import avr_trouble


def test_an_ordinary_frame_is_understood_by_an_avr() -> None:
    assert avr_trouble(b"MNERIM 034 parafrente 100 PC 02123") is None


def test_a_word_of_more_than_twenty_bytes_overruns_its_buffer() -> None:
    assert avr_trouble(b"R 050 " + b"x" * 20 + b" PC 00000") is None
    assert "longer than the 20 bytes" in str(avr_trouble(b"R 051 " + b"x" * 21 + b" PC 00000"))


def test_a_sum_beyond_signed_sixteen_bits_fails() -> None:
    words = b" ".join([b"z" * 20] * 14)
    assert "add up to" in str(avr_trouble(b"R 318 " + words + b" PC 00000"))
