"""How annotations are checked while the tests run: as static checkers read them, where an int passes for a float."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
