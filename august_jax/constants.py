"""Physical constants, SI units (CODATA 2018)."""

SPEED_OF_LIGHT = 299_792_458.0
"""c, speed of light in vacuum [m/s]."""

VACUUM_PERMITTIVITY = 8.854_187_812_8e-12
"""eps0, permittivity of vacuum [F/m]."""

GRAVITY = 9.806_65
"""Standard acceleration of free fall [m/s^2]."""
