"""Ground and walls: a written-out twin, image theory in closed form, Fresnel's limits, reciprocity, and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross, turned

from august_jax.physics import (
    AntennaArray,
    Cells,
    PlanarArray,
    Plane,
    body_channel,
    contrast,
    dipole_fields,
    environment_channel,
    environment_sensing_channel,
    factor_body,
    fisher_information,
    fresnel,
    interaction_matrix,
    mirrored,
    sensing_channel,
    stack_tables,
    table_channel,
    tabulate,
    wavenumber,
)
from august_jax.physics.mom import weighted_fields

ARRAY = PlanarArray(4, 2, 3e9)
PLACE = np.array([1.0, 2.5, 0.7], np.float32)
TURN = turned([0.7, -0.4, 0.3]).astype(np.float32)
CHI = 2.0 + 0.03j
CELLS = cross(arm=3)
SOIL = 9.0 + 1.2j
GROUND, WALL = ([0.0, 0.0, -0.9], [0.0, 0.0, 1.0]), ([2.4, 0.0, 0.0], [-3.0, 0.0, 0.0])
SLOPE = ([0.1, 0.2, -1.1], [0.1, -0.2, 1.0])
K = wavenumber(3e9)


def scattered(count=3, seed=0):
    """Antennas at random places within 0.3 m, each turned its own way."""
    random = np.random.default_rng(seed)
    moments = random.normal(size=(count, 3))
    moments /= np.linalg.norm(moments, axis=1, keepdims=True)
    return AntennaArray(random.uniform(-0.3, 0.3, (count, 3)), moments, 3e9)


@pytest.fixture(scope="module")
def body():
    return factor_body(CELLS, 3e9)


def moved(rotation=TURN, place=PLACE):
    return CELLS.moved(jnp.asarray(np.asarray(rotation, float)), jnp.asarray(np.asarray(place, float)))


def off(value, reference):
    return np.linalg.norm(value - reference) / np.linalg.norm(reference)


def exact(array, planes, **options):
    """The coupled solve in double precision, with angles towards the body's origin."""
    with jax.enable_x64(True):
        options = {"place": PLACE.astype(float)} | options
        return np.asarray(environment_sensing_channel(array, moved(), CHI, planes, **options))


# ---- a twin, as the textbooks have it: rays, planes of incidence, one antenna and one cell at a time


def green(offset):
    r = np.linalg.norm(offset)
    unit, kr = offset / r, K * r
    g, h = 3 / kr**2 - 3j / kr - 1, 1 / kr**2 - 1j / kr - 1
    return (g * np.outer(unit, unit) - h * np.eye(3)) * np.exp(1j * kr) / (4 * np.pi * r)


def reflection(plane, direction, moment):
    """Moment of the image behind a plane, for a ray that leaves the plane in a direction."""
    n = np.asarray(plane.normal, float) / np.linalg.norm(plane.normal)
    mirror = np.eye(3) - 2 * np.outer(n, n)
    if plane.coefficient is not None:
        return plane.coefficient * mirror @ moment
    angle = np.arccos(direction @ n)
    inside = np.sqrt(plane.permittivity - np.sin(angle) ** 2 + 0j)
    te = (np.cos(angle) - inside) / (np.cos(angle) + inside)
    tm = (plane.permittivity * np.cos(angle) - inside) / (plane.permittivity * np.cos(angle) + inside)
    s = np.cross(direction, n) / np.linalg.norm(np.cross(direction, n))
    p_in, p_out = np.cross(s, mirror @ direction), np.cross(s, direction)  # E of TM about the same H, along s
    found = te * s * (s @ moment) + tm * p_out * (p_in @ moment)
    # The part along the ray, of the near field alone, is reflected as TM is.
    return found + -tm * direction * (mirror @ direction @ moment)


def image_field(chain, antenna, moment, place, point):
    """Of an antenna by planes in turn, at a point; rays go to the place."""
    behind = antenna
    for plane in chain:
        n = np.asarray(plane.normal, float) / np.linalg.norm(plane.normal)
        behind = behind - 2 * ((behind - plane.point) @ n) * n
    directions = [(place - behind) / np.linalg.norm(place - behind)]
    for plane in chain[:0:-1]:
        n = np.asarray(plane.normal, float) / np.linalg.norm(plane.normal)
        directions.insert(0, directions[0] - 2 * (directions[0] @ n) * n)
    for plane, direction in zip(chain, directions):
        moment = reflection(plane, direction, moment)
    return green(point - behind) @ moment


def twin(array, cells, chi, chains, place):
    fields = np.zeros((cells.count, 3, array.count), complex)
    for i, point in enumerate(np.asarray(cells.sites(), float)):
        for n, (antenna, moment) in enumerate(zip(np.asarray(array.positions), np.asarray(array.moments))):
            fields[i, :, n] = green(point - antenna) @ moment
            for chain in chains:
                fields[i, :, n] += image_field(chain, antenna, moment, place, point)
    with jax.enable_x64(True):
        weighted = np.asarray(weighted_fields(cells, jnp.asarray(fields.reshape(-1, array.count))))
        matrix = np.asarray(interaction_matrix(cells, K))
    return K**2 * weighted.T @ np.linalg.solve(np.eye(len(matrix)) / chi - matrix, weighted)


@pytest.mark.parametrize("array", [ARRAY, scattered()], ids=["planar", "scattered"])
def test_channels_agree_with_the_written_out_twin(array):
    planes = [Plane(*SLOPE, permittivity=SOIL), Plane(*WALL, coefficient=-0.6 + 0.3j)]
    chains, place = [[plane] for plane in planes], PLACE.astype(float)
    with jax.enable_x64(True):
        cells = jax.tree.map(np.asarray, moved())
    assert off(exact(array, planes), twin(array, cells, CHI, chains, place)) < 1e-10
    assert off(twin(array, cells, CHI, chains, place), twin(array, cells, CHI, [], place)) > 0.1


@pytest.mark.parametrize("reflects", [{"permittivity": SOIL}, {"coefficient": -0.5}], ids=["soil", "constant"])
def test_a_corner_reflects_twice(reflects):
    """From the array the ray by both planes meets the wall first (it is near the body, and the ground is not)."""
    ground, wall = Plane(*GROUND, **reflects), Plane(*WALL, permittivity=4.0)
    place = PLACE.astype(float)
    behind = np.array([4.8, 0.0, -1.8])
    at_wall, at_ground = (behind[0] - 2.4) / (behind[0] - place[0]), (-0.9 + 1.8) / (place[2] + 1.8)
    assert at_wall > at_ground  # of the straight line from the image: the wall is the last
    with jax.enable_x64(True):
        cells = jax.tree.map(np.asarray, moved())
    wanted = twin(ARRAY, cells, CHI, [[ground], [wall], [ground, wall]], place)
    for planes in ([ground, wall], [wall, ground]):
        assert off(exact(ARRAY, planes, corners=True), wanted) < 1e-10
    assert off(exact(ARRAY, [ground, wall]), wanted) > 0.01


# ---- image theory


def test_no_field_is_left_along_a_perfect_conductor():
    array = scattered(4)
    plane = Plane(*SLOPE, coefficient=-1.0)
    n = np.asarray(SLOPE[1]) / np.linalg.norm(SLOPE[1])
    along = np.linalg.svd(n[None])[2][1:]
    points = np.asarray(SLOPE[0]) + np.random.default_rng(1).normal(size=(20, 2)) @ along
    with jax.enable_x64(True):
        image = mirrored(array, plane)
        direct, reflected = (
            np.asarray(dipole_fields(jnp.asarray(points), *map(jnp.asarray, (end.positions, end.moments)), K))
            for end in (array, image)
        )
    total = (direct - reflected).reshape(20, 3, 4)
    assert np.abs(np.einsum("ta,pan->tpn", along, total)).max() < 1e-12 * np.abs(direct).max()
    # A dipole along the normal is kept: its two fields add up.
    assert np.allclose(np.asarray(image.moments) @ n, -(array.moments @ n))
    assert np.abs(np.einsum("a,pan->pn", n, total)).max() > 0.1 * np.abs(direct).max()


def test_a_point_over_a_perfect_conductor_is_its_closed_form():
    """One weak cell, in the field of an antenna and of its explicitly mirrored dipole; tangential, normal, and both."""
    for moment in ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.6, 0.0, 0.8]):
        antenna, place = np.array([0.2, -0.1, 0.4]), np.array([1.0, 2.0, 1.1])
        image, opposite = np.array([0.2, -0.1, -2.2]), np.array([-moment[0], -moment[1], moment[2]])
        field = green(place - antenna) @ moment + green(place - image) @ opposite
        array, volume, chi = AntennaArray(antenna[None], np.array([moment]), 3e9), 1e-6, 1e-6
        with jax.enable_x64(True):
            cells = Cells(jnp.asarray(place[None]), jnp.full(1, volume))
            plane = Plane(*GROUND, coefficient=-1.0)
            found = environment_sensing_channel(array, cells, chi, [plane], solver="born")
        assert off(np.asarray(found), K**2 * chi * volume * field @ field) < 1e-9


def test_two_rays_over_distance():
    """A horizontal dipole across the plane of incidence: |E| = |wave + r_TE wave'|, near fields included; in the far
    distance the rays cancel, and what is heard of a point falls as the fourth power of the distance."""
    height, other, eps, sigma = 1.5, 2.0, 15.0, 0.01
    distances = np.array([3.0, 6.0, 11.0, 24.0, 70.0, 150.0, 2000.0, 4000.0])
    medium = complex(1.0 + contrast(eps, sigma, 3e9))
    array = AntennaArray(np.array([[0.0, 0.0, height]]), np.array([[0.0, 1.0, 0.0]]), 3e9)

    def wave(r):
        return (1 + 1j / (K * r) - 1 / (K * r) ** 2) * np.exp(1j * K * r) / (4 * np.pi * r)

    heard = []
    with jax.enable_x64(True):
        plane = Plane([0.0, 0.0, 0.0], [0.0, 0.0, 2.0], permittivity=medium)
        for distance in distances:
            cells = Cells(jnp.asarray([[distance, 0.0, other]]), jnp.full(1, 1e-6))
            heard.append(complex(environment_sensing_channel(array, cells, 1e-6, [plane], solver="born")[0, 0]))
    direct, reflected = np.hypot(distances, height - other), np.hypot(distances, height + other)
    c = (height + other) / reflected
    q = np.sqrt(medium - (1 - c**2))
    field = wave(direct) + (c - q) / (c + q) * wave(reflected)
    np.testing.assert_allclose(heard, K**2 * 1e-12 * field**2, rtol=1e-7)
    assert 20 * np.log10(abs(heard[-2] / heard[-1])) == pytest.approx(80 * np.log10(2.0), abs=0.3)


# ---- Fresnel


def test_fresnel_limits():
    with jax.enable_x64(True):
        eps = 4.0
        te, tm = (complex(part) for part in fresnel(eps, 1.0))  # normal incidence: one and the same, but for its sign
        assert te == pytest.approx((1 - 2) / (1 + 2)) and tm == pytest.approx(-te)
        assert np.allclose(fresnel(SOIL, 1e-9), -1.0, atol=1e-7)  # grazing
        brewster = np.cos(np.arctan(np.sqrt(eps)))
        assert abs(fresnel(eps, brewster)[1]) < 1e-12 < abs(fresnel(eps, brewster)[0])
        metal = 1.0 + contrast(1.0, 1e12, 3e9)
        te, tm = (np.asarray(part) for part in fresnel(metal, jnp.linspace(0.05, 1.0, 9)))
        assert np.allclose(te, -1.0, atol=1e-3) and np.allclose(tm, 1.0, atol=1e-3)
        assert not np.any(np.asarray(fresnel(1.0, jnp.linspace(0.0, 1.0, 9)[1:])))  # no interface, not to a rounding
        # The field along the interface goes through it: 1 + r_TE = t_TE, and cos t (1 - r_TM) = cos t' t_TM.
        c = jnp.linspace(0.1, 1.0, 7)
        q = jnp.sqrt(SOIL - (1 - c**2))
        te, tm = fresnel(SOIL, c)
        assert np.allclose(1 + te, 2 * c / (c + q))
        assert np.allclose(c * (1 - tm), q / SOIL * (1 + tm))  # E along the plane, H of TM along it kept


def test_no_medium_reflects_more_than_it_gets():
    random = np.random.default_rng(0)
    eps = random.uniform(-5.0, 40.0, 4000) + 1j * np.exp(random.uniform(-7.0, 9.0, 4000))
    cosine = random.uniform(0.0, 1.0, 4000)
    for part in fresnel(eps.astype(np.complex64), cosine.astype(np.float32)):
        assert np.abs(part).max() < 1.0 + 1e-5


def test_a_good_conductor_is_a_perfect_one():
    metal = complex(1.0 + contrast(1.0, 1e14, 3e9))
    fine = exact(ARRAY, [Plane(*SLOPE, permittivity=metal)])
    assert off(fine, exact(ARRAY, [Plane(*SLOPE, coefficient=-1.0)])) < 1e-4


# ---- the doors


@pytest.mark.parametrize(
    "planes",
    [
        [Plane(*GROUND, coefficient=0.0)],
        [Plane(*GROUND, permittivity=1.0), Plane(*WALL, permittivity=1.0)],
        [Plane(*SLOPE, coefficient=0.0), Plane(*WALL, permittivity=1.0)],
        [],
    ],
    ids=["ground", "air", "both", "none"],
)
def test_a_coefficient_of_zero_is_free_space_to_the_bit(planes, body):
    free = body_channel(body, ARRAY, TURN, PLACE, CHI)
    np.testing.assert_array_equal(environment_channel(body, ARRAY, TURN, PLACE, CHI, planes), free)
    two = body_channel(body, ARRAY, TURN, PLACE, CHI, receiver=scattered())
    np.testing.assert_array_equal(environment_channel(body, ARRAY, TURN, PLACE, CHI, planes, receiver=scattered()), two)
    with jax.enable_x64(True):
        free = sensing_channel(ARRAY, moved(), CHI)
    assert off(exact(ARRAY, planes), np.asarray(free)) < 1e-12


SETTINGS = [
    ([Plane(*SLOPE, permittivity=SOIL), Plane(*WALL, coefficient=-0.7j)], False),
    ([Plane(*GROUND, permittivity=SOIL), Plane(*WALL, permittivity=5.0)], True),
    ([Plane(*GROUND, coefficient=-0.8)], False),
]


@pytest.mark.parametrize(
    ("planes", "corners"),
    [
        pytest.param(*SETTINGS[0], marks=pytest.mark.slow, id="slope and wall"),
        pytest.param(*SETTINGS[1], marks=pytest.mark.slow, id="corner"),
        pytest.param(*SETTINGS[2], id="constant"),
    ],
)
def test_a_factored_body_equals_the_coupled_solve(planes, corners, body):
    options = {"corners": corners}
    fast = np.asarray(environment_channel(body, ARRAY, TURN, PLACE, CHI, planes, **options))
    slow = exact(ARRAY, planes, **options)
    assert off(fast, slow) < 1e-4
    assert off(np.asarray(body_channel(body, ARRAY, TURN, PLACE, CHI)), slow) > 0.1
    np.testing.assert_array_equal(fast, fast.T)  # reciprocity
    np.testing.assert_allclose(slow, slow.T, rtol=1e-10, atol=1e-12 * np.abs(slow).max())
    there = np.asarray(environment_channel(body, ARRAY, TURN, PLACE, CHI, planes, receiver=scattered(), **options))
    back = np.asarray(environment_channel(body, scattered(), TURN, PLACE, CHI, planes, receiver=ARRAY, **options))
    assert off(there, back.T) < 1e-5
    assert off(there, exact(ARRAY, planes, receiver=scattered(), **options)) < 1e-4


@pytest.mark.parametrize(
    ("planes", "corners"),
    [pytest.param(*SETTINGS[1], marks=pytest.mark.slow, id="corner"), pytest.param(*SETTINGS[2], id="constant")],
)
def test_a_table_of_the_array_and_its_images_serves_too(planes, corners, body):
    """To the table's own error; the planes are near, so that a patch holds array and images."""
    near = [Plane([0.0, 0.0, -0.35], [0.0, 0.0, 1.0], planes[0].permittivity, planes[0].coefficient)]
    if corners:
        near.append(Plane([-0.4, 0.0, 0.0], [1.0, 0.0, 0.0], permittivity=5.0))
    images = [mirrored(ARRAY, plane) for plane in near]
    every = AntennaArray.joined(ARRAY, *images, *([mirrored(images[0], near[1])] if corners else []))
    place = np.array([0.8, 3.5, 0.9], np.float32)
    table = tabulate(body, every, distance_m=(3.3, 4.4), contrast=(1.5, 2.5), cache=False)
    error = 3.0 * float(np.max(table.errors))
    exact_ = np.asarray(environment_channel(body, ARRAY, TURN, place, CHI, near, corners=corners))
    found = np.asarray(environment_channel(table, ARRAY, TURN, place, CHI, near, corners=corners))
    assert error < 0.1 and off(found, exact_) < error
    assert off(np.asarray(body_channel(body, ARRAY, TURN, place, CHI)), exact_) > 0.1
    stacked = environment_channel(stack_tables([table] * 2), ARRAY, TURN, place, CHI, near, corners=corners, craft=1)
    assert off(np.asarray(stacked), found) < 1e-5
    other = AntennaArray(0.2 * scattered().positions, scattered().moments, 3e9)
    across = environment_channel(table, ARRAY, TURN, place, CHI, near, receiver=other, corners=corners)
    wanted = environment_channel(body, ARRAY, TURN, place, CHI, near, receiver=other, corners=corners)
    assert off(np.asarray(across), np.asarray(wanted)) < 2.0 * error
    free = environment_channel(table, ARRAY, TURN, place, CHI, [Plane(*GROUND, coefficient=0.0)])
    np.testing.assert_array_equal(free, table_channel(table, ARRAY, TURN, place, CHI))


@pytest.mark.slow
def test_tones_have_planes_of_their_own():
    tones = (2.95e9, 3.05e9)
    comb, chi = factor_body(CELLS, tones), np.asarray(contrast(3.0, 0.01, np.asarray(tones)))
    soil = 1.0 + np.asarray(contrast(9.0, 0.2, np.asarray(tones)))
    planes = [Plane(*SLOPE, permittivity=soil), Plane(*WALL, coefficient=[-0.5, 0.2j])]
    both = np.asarray(environment_channel(comb, ARRAY, TURN, PLACE, chi, planes))
    assert both.shape == (2, 8, 8)
    for tone in range(2):
        own = [Plane(*SLOPE, permittivity=soil[tone]), Plane(*WALL, coefficient=[-0.5, 0.2j][tone])]
        with jax.enable_x64(True):
            slow = environment_sensing_channel(
                ARRAY, moved(), chi[tone], own, place=PLACE.astype(float), frequencies_hz=tones[tone : tone + 1]
            )
        assert off(both[tone], np.asarray(slow)[0]) < 1e-4


def test_vmap_and_jit(body):
    heights = jnp.asarray([-0.9, -1.4])
    places = jnp.asarray(np.stack([PLACE, PLACE + 0.3]))

    def channel(height, place):
        ground = Plane(jnp.stack([0.0, 0.0, height]), jnp.asarray([0.0, 0.0, 1.0]), permittivity=SOIL)
        return environment_channel(body, ARRAY, jnp.asarray(TURN), place, CHI, [ground])

    many = jax.jit(jax.vmap(channel))(heights, places)
    for row in range(2):
        assert off(np.asarray(many[row]), np.asarray(channel(heights[row], places[row]))) < 1e-5
    points = jnp.asarray([[0.0, 0.0, height] for height in (-0.9, -1.4)])
    planes = Plane(points, jnp.asarray([[0.0, 0.0, 1.0]] * 2), coefficient=jnp.asarray([-0.5, 0.3j]))
    many = jax.vmap(lambda plane: environment_channel(body, ARRAY, TURN, PLACE, CHI, [plane]))(planes)
    one = environment_channel(body, ARRAY, TURN, PLACE, CHI, [Plane([0.0, 0.0, -1.4], GROUND[1], coefficient=0.3j)])
    assert off(np.asarray(many[1]), np.asarray(one)) < 1e-5


@pytest.mark.slow
def test_gradients_agree_with_differences(body):
    """In height, tilt, permittivity and coefficient, through the coupled solve; and in height through the body."""
    weights = np.random.default_rng(2).normal(size=(ARRAY.count,) * 2)

    def planes(height, tilt, eps, sigma, level):
        ground = Plane(jnp.stack([0.0, 0.0, height]), jnp.stack([tilt, 0.0, 1.0]), 1.0 + contrast(eps, sigma, 3e9))
        return [ground, Plane(*WALL, coefficient=level * jnp.exp(0.3j))]

    start = (-0.9, 0.1, 9.0, 0.2, 0.4)
    with jax.enable_x64(True):
        cells = moved()

        @jax.jit
        def value(*at):
            channel = environment_sensing_channel(ARRAY, cells, CHI, planes(*at))
            return jnp.sum(weights * jnp.abs(channel)) * 1e6

        slopes = jax.jit(jax.grad(value, argnums=range(5)))(*start)
        for row, slope in enumerate(slopes):
            ahead, behind = (value(*(x + sign * 1e-5 * (n == row) for n, x in enumerate(start))) for sign in (1, -1))
            np.testing.assert_allclose(slope, (ahead - behind) / 2e-5, rtol=1e-5)

    def strength(height):
        channel = environment_channel(body, ARRAY, TURN, PLACE, CHI, planes(height, *start[1:]))
        return jnp.sum(jnp.asarray(weights, jnp.float32) * jnp.abs(channel)) * 1e6

    # Central differences in float32 are good to the cube root of its rounding.
    assert jax.grad(strength)(-0.9) == pytest.approx(float(strength(-0.898) - strength(-0.902)) / 4e-3, rel=3e-2)
    ahead, behind = (float(strength_above(body, z)) for z in (1.002, 0.998))
    assert jax.grad(lambda z: strength_above(body, z))(1.0) == pytest.approx((ahead - behind) / 4e-3, rel=3e-2)


def strength_above(body, z):
    """Of a body straight above the array, where the plane of incidence of the middle is undefined."""
    ground = Plane([0.0, 0.0, -1.0], [0.0, 0.0, 1.0], permittivity=SOIL)
    one = AntennaArray(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]), 3e9)
    place = jnp.stack([0.0, 0.0, 1.5 + z])
    return 1e6 * jnp.sum(jnp.abs(environment_channel(body, one, jnp.eye(3), place, CHI, [ground])))


def test_what_goes_between_body_and_ground_falls_as_its_height_grows():
    """The whole problem over a perfect conductor, each cell coupled to the images of all, too, is the measure. Over a
    period of the interference, what is left out is as small as the module says."""
    array = AntennaArray(PlanarArray(2, 2, 3e9).positions + [0.0, 0.0, 0.6], PlanarArray(2, 2, 3e9).moments, 3e9)
    with jax.enable_x64(True):
        cells = jax.tree.map(np.asarray, moved())
        alone = np.asarray(interaction_matrix(cells, K)).reshape(cells.count, 3, cells.count, 3)
        weight = np.asarray(jnp.sqrt(cells.fractions() * cells.volumes))
    positions, mirror = np.asarray(cells.positions), np.diag([1.0, 1.0, -1.0])
    material = float(np.sum(weight**2))

    def error(height):
        ground = positions[:, 2].mean() - height
        matrix = alone.copy()
        for i, j in np.ndindex(cells.count, cells.count):
            image = positions[j] * [1, 1, -1] + [0, 0, 2 * ground]
            matrix[i, :, j, :] += K**2 * weight[i] * weight[j] * green(positions[i] - image) @ -mirror
        fields = np.zeros((cells.count, 3, array.count), complex)
        for i, n in np.ndindex(cells.count, array.count):
            antenna, moment = array.positions[n], array.moments[n]
            image, opposite = antenna * [1, 1, -1] + [0, 0, 2 * ground], -mirror @ moment
            fields[i, :, n] = green(positions[i] - antenna) @ moment + green(positions[i] - image) @ opposite
        with jax.enable_x64(True):
            plane = Plane([0.0, 0.0, ground], [0.0, 0.0, 1.0], coefficient=-1.0)
            found = np.asarray(environment_sensing_channel(array, cells, CHI, [plane]))
        weighted = np.repeat(weight, 3)[:, None] * fields.reshape(-1, array.count)
        matrix = matrix.reshape(3 * cells.count, -1)
        return off(found, K**2 * weighted.T @ np.linalg.solve(np.eye(len(matrix)) / CHI - matrix, weighted))

    errors = [np.mean([error(height + step) for step in (0.0, 0.0125, 0.025, 0.0375)]) for height in (0.2, 0.6, 1.8)]
    stated = [K**2 * abs(CHI) * material / (8 * np.pi * height) for height in (0.2, 0.6, 1.8)]
    assert errors[0] > 1.5 * errors[1] > 2.25 * errors[2]
    assert np.all(np.array(errors) < stated)


@pytest.mark.slow
def test_information_beside_known_planes_is_that_of_differences(body):
    from scipy.spatial.transform import Rotation

    planes = [Plane(*SLOPE, permittivity=SOIL), Plane(*WALL, coefficient=-0.7)]

    def channel(theta):
        with jax.enable_x64(True):
            place = PLACE.astype(float) + theta[:3]
            cells = moved(Rotation.from_rotvec(theta[3:6]).as_matrix() @ TURN, place)
            chi = complex(contrast(3.0 + theta[6], 5e-3 + theta[7], 3e9))
            found = environment_sensing_channel(ARRAY, cells, chi, planes, place=place)
            return np.asarray(found) * np.exp(theta[8] + 1j * theta[9])

    steps = np.array([1e-5] * 3 + [1e-4] * 3 + [1e-3, 1e-4, 1e-4, 1e-4])
    slopes = [(channel(step * axis) - channel(-step * axis)) / (2 * step) for step, axis in zip(steps, np.eye(10))]
    gram = np.real(np.einsum("amn,bmn->ab", slopes, np.conj(slopes)))
    expected = 2 * 100.0 * ARRAY.count**2 * gram / np.linalg.norm(channel(np.zeros(10))) ** 2
    found = fisher_information(body, ARRAY, TURN, PLACE, 3.0, 5e-3, 100.0, planes=planes)
    scale = np.sqrt(np.diag(expected))
    # Derivatives in float32 through a response good to 3e-5.
    np.testing.assert_allclose(found / scale / scale[:, None], expected / scale / scale[:, None], atol=2e-3)
    free = fisher_information(body, ARRAY, TURN, PLACE, 3.0, 5e-3, 100.0)
    off_ = fisher_information(body, ARRAY, TURN, PLACE, 3.0, 5e-3, 100.0, planes=[Plane(*GROUND, coefficient=0.0)])
    assert np.linalg.norm(free - expected) > 0.1 * np.linalg.norm(expected)
    np.testing.assert_array_equal(off_, free)


# ---- what is refused

FINE = Plane(*GROUND, coefficient=-0.5)
BEHIND = AntennaArray(np.array([[0.0, 0.0, -2.0]]), np.array([[0.0, 0.0, 1.0]]), 3e9)


def of(*planes, array=ARRAY, place=PLACE, **options):
    return lambda body: environment_channel(body, array, TURN, place, CHI, planes, **options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda body: Plane([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], coefficient=0.1), "normal: is zero"),
        (lambda body: Plane([0.0, 0.0, np.nan], GROUND[1], coefficient=0.1), "point: holds NaN"),
        (lambda body: Plane(GROUND[0], [0.0, np.inf, 0.0], coefficient=0.1), "normal: holds NaN"),
        (lambda body: Plane([0.0, 0.0], GROUND[1], coefficient=0.1), r"point: got shape \(2,\)"),
        (lambda body: Plane(*GROUND, coefficient=1.1), "coefficient: got a modulus of 1.1"),
        (lambda body: Plane(*GROUND, coefficient=0.9 - 0.9j), "coefficient: got a modulus of 1.27"),
        (lambda body: Plane(*GROUND, coefficient=np.nan), "coefficient: holds NaN"),
        (lambda body: Plane(*GROUND, permittivity=np.nan), "permittivity: holds NaN"),
        (lambda body: Plane(*GROUND, permittivity=4.0 - 0.1j), "permittivity: got an imaginary part of -0.1"),
        (lambda body: Plane(*GROUND), "permittivity, coefficient: got neither"),
        (lambda body: Plane(*GROUND, permittivity=4.0, coefficient=0.1), "permittivity, coefficient: got both"),
        (
            of(Plane([0.0, 0.0, 0.69], GROUND[1], coefficient=0.1)),
            "array: a place is 0.7.* m behind number 0 of planes",
        ),
        (of(FINE, Plane([0.0, 0.0, 0.71], [0.0, 0.0, -1.0], coefficient=0.1)), "translation: the body, .* number 1"),
        (of(FINE, place=PLACE * [1.0, 1.0, -2.0]), "translation: the body, .* m in radius, reaches 0.5"),
        (of(FINE, receiver=BEHIND), "receiver: a place is 1.1 m"),
        (of(Plane(*GROUND, coefficient=[0.1, 0.2])), r"planes: number 0 has a coefficient of shape \(2,\)"),
        (
            of(Plane(np.array([GROUND[0]] * 2), GROUND[1], coefficient=0.1)),
            r"planes: number 0 has a point of shape \(2, 3\)",
        ),
        (of(FINE, Plane(*SLOPE, coefficient=0.1), corners=True), "planes: the normals of numbers 0 and 1 are 12.6"),
        (of(FINE, place=PLACE * np.nan), "translation: holds NaN"),
        (
            lambda body: fisher_information(body, ARRAY, TURN, PLACE * [1, 1, -2], 3.0, 5e-3, 100.0, planes=[FINE]),
            "position: the body, .* behind number 0",
        ),
        (of(FINE, craft=1), "craft: got 1, but a factored body"),
        (of(FINE, place=np.array([0.1, 0.5, 0.0])), "translation: the body is .* smaller nearest_m"),
        (
            lambda body: environment_sensing_channel(ARRAY, moved(place=PLACE - [0.0, 0.0, 1.61]), CHI, [FINE]),
            "cells.positions: a place is .* behind number 0",
        ),
    ],
)
def test_what_cannot_be_is_refused(body, call, message, unchecked):
    with pytest.raises(ValueError, match=message):
        call(body)
