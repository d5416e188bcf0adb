"""What is left of equal pieces, by those that are done; bytes as people read them."""

from august_jax import progress


def test_time_left_is_that_of_the_pieces_to_come_in_seconds_or_minutes(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    clock = progress.TimeLeft(4)
    assert clock.each_s == 0.0
    now[0] += 60.0
    assert clock.after_one() == "3 min left" and clock.each_s == 60.0
    now[0] += 20.0  # the second was quicker
    assert clock.after_one() == "80 s left" and clock.each_s == 40.0
    now[0] += 40.0
    clock.after_one()
    assert clock.after_one() == "0 s left"


def test_bytes_are_told_in_the_unit_that_keeps_a_digit():
    assert [progress.told_bytes(count) for count in (400_000, 99_000_000, 100_000_000, 28_744_000_000)] == [
        "0.4 MB", "99.0 MB", "0.1 GB", "28.7 GB",
    ]  # fmt: skip
