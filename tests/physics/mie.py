"""Mie series of a homogeneous sphere under e^{-jwt}, independent of the simulator (Bohren and Huffman, chapter 4)."""

import numpy as np
from scipy.special import spherical_jn, spherical_yn


def amplitudes(permittivity, x, angles):
    """S1 and S2 at scattering angles [rad] for size parameter x = ka and complex relative permittivity; an infinite
    one is that of a perfect conductor."""
    return summed(*(conductor(x) if np.isinf(permittivity) else coefficients(permittivity, x)), angles)


def coefficients(permittivity, x):
    """a_n and b_n of a sphere, the electric and the magnetic orders."""
    index = np.sqrt(complex(permittivity))
    orders = np.arange(1, int(x + 4.0 * x ** (1 / 3) + 12))

    def riccati(z):
        value, slope = spherical_jn(orders, z), spherical_jn(orders, z, derivative=True)
        return z * value, value + z * slope

    psi, psi_slope = riccati(x)
    inside, inside_slope = riccati(index * x)
    y, y_slope = spherical_yn(orders, x), spherical_yn(orders, x, derivative=True)
    xi = psi + 1j * x * y
    xi_slope = psi_slope + 1j * (y + x * y_slope)
    a = (index * inside * psi_slope - psi * inside_slope) / (index * inside * xi_slope - xi * inside_slope)
    b = (inside * psi_slope - index * psi * inside_slope) / (inside * xi_slope - index * xi * inside_slope)
    return a, b


def summed(a, b, angles):
    """S1 and S2 at scattering angles [rad] of a_n and b_n."""
    orders, cosine = np.arange(1, len(a) + 1), np.cos(angles)
    s1, s2 = np.zeros(len(angles), complex), np.zeros(len(angles), complex)
    before, current = np.zeros_like(cosine), np.ones_like(cosine)  # pi_0, pi_1
    for order in orders:
        tau = order * cosine * current - (order + 1) * before
        weight = (2 * order + 1) / (order * (order + 1))
        s1 += weight * (a[order - 1] * current + b[order - 1] * tau)
        s2 += weight * (a[order - 1] * tau + b[order - 1] * current)
        before, current = current, ((2 * order + 1) * cosine * current - (order + 1) * before) / order
    return s1, s2


def conductor(x):
    """a_n and b_n of a perfectly conducting sphere, to which those of a metal tend."""
    orders = np.arange(1, int(x + 4.0 * x ** (1 / 3) + 12))
    j, y = spherical_jn(orders, x), spherical_yn(orders, x)
    psi_slope = j + x * spherical_jn(orders, x, derivative=True)
    xi_slope = psi_slope + 1j * (y + x * spherical_yn(orders, x, derivative=True))
    return psi_slope / xi_slope, j / (j + 1j * y)
