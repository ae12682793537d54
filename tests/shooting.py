"""Periodic orbits by multiple shooting, as a reference that shares nothing with the package.

Everything rests on `scipy.integrate.solve_ivp` (DOP853) with the variational equations integrated along. The values in
capital letters are described where they stand; `python -m tests.shooting` computes all of them again.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

Field = Callable[[float, np.ndarray], np.ndarray]

# φ'' + c1 tanh(φ'/width) + c2 φ' + c3 φ'|φ'| + (g + lift ω² cos ωt)/length · sin φ = 0, SI units.
PENDULUM = {"c1": 0.02, "c2": 0.05, "c3": 0.05, "width": 0.05, "g": 9.81, "lift": 0.11, "length": 0.30}


class Known(NamedTuple):
    """A periodic orbit of the pendulum as it stands in the tables.

    `section` holds (φ, φ') at t = 0, T, 2T, …, one row per forcing period T = 2π/ω, with φ not wrapped: one more period
    leads from the last row to the first with φ larger by 2π·winding. So each period can be integrated from its own
    row, with no search and little growth of errors. The multiplier of larger modulus comes first. φ → −φ with
    winding → −winding is another orbit with the same multipliers.
    """

    omega: float
    winding: int
    section: tuple[tuple[float, float], ...]
    multipliers: tuple[complex, complex]


class Orbit(NamedTuple):
    """A periodic orbit as a chain of segments.

    Attributes
    ----------
    times : numpy.ndarray
        Starts of the segments and the end of the last one.
    states : numpy.ndarray
        State at the start of every segment.
    transfer : numpy.ndarray
        Derivative of each segment's end by its start.
    multipliers : numpy.ndarray
        Floquet multipliers, largest modulus first.
    correction : float
        Largest component of the last Newton step.
    """

    times: np.ndarray
    states: np.ndarray
    transfer: np.ndarray
    multipliers: np.ndarray
    correction: float


def pendulum(omega: float, **changes: float) -> tuple[Field, Field, float]:
    """Return slope, Jacobian and forcing period of the driven pendulum; `changes` replace values of PENDULUM."""
    p = PENDULUM | changes
    c1, c2, c3, width = p["c1"], p["c2"], p["c3"], p["width"]

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        angle, rate = y
        pull = (p["g"] + p["lift"] * omega**2 * np.cos(omega * t)) / p["length"]
        return np.array([rate, -c1 * np.tanh(rate / width) - (c2 + c3 * abs(rate)) * rate - pull * np.sin(angle)])

    def jacobian(t: float, y: np.ndarray) -> np.ndarray:
        angle, rate = y
        pull = (p["g"] + p["lift"] * omega**2 * np.cos(omega * t)) / p["length"]
        friction = c1 / width * (1.0 - np.tanh(rate / width) ** 2) + c2 + 2.0 * c3 * abs(rate)
        return np.array([[0.0, 1.0], [-pull * np.cos(angle), -friction]])

    return slope, jacobian, 2.0 * np.pi / omega


def pendulum_with_omega(**changes: float) -> tuple[Field, Field]:
    """Return slope and Jacobian of the pendulum in time over T, with ω as a third, constant state."""
    p = PENDULUM | changes

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        inner, _, period = pendulum(y[2], **changes)
        return np.append(period * inner(t * period, y[:2]), 0.0)

    def jacobian(t: float, y: np.ndarray) -> np.ndarray:
        inner, by_state, period = pendulum(y[2], **changes)
        j = np.zeros((3, 3))
        j[:2, :2] = period * by_state(t * period, y[:2])
        j[:2, 2] = -period / y[2] * inner(t * period, y[:2])
        j[1, 2] -= period * 2.0 * p["lift"] * y[2] * np.cos(2.0 * np.pi * t) / p["length"] * np.sin(y[0])
        return j

    return slope, jacobian


def van_der_pol(mu: float) -> tuple[Field, Field]:
    """Return slope and Jacobian of x'' − μ (1 − x²) x' + x = 0 in time over T, with T as a third, constant state."""

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        x, v, period = y
        return np.array([period * v, period * (mu * (1.0 - x * x) * v - x), 0.0])

    def jacobian(t: float, y: np.ndarray) -> np.ndarray:
        x, v, period = y
        force = mu * (1.0 - x * x) * v - x
        return np.array(
            [
                [0.0, period, v],
                [-period * (1.0 + 2.0 * mu * x * v), period * mu * (1.0 - x * x), force],
                [0.0, 0.0, 0.0],
            ]
        )

    return slope, jacobian


def flow(
    slope: Field,
    jacobian: Field,
    start: float,
    end: float,
    state: np.ndarray,
    tolerance: float = 3e-14,
    method: str = "DOP853",
) -> tuple[np.ndarray, np.ndarray]:
    """Return the state at the end of one segment and its derivative by the state at the start."""
    count = len(state)

    def extended(t: float, z: np.ndarray) -> np.ndarray:
        tangent = jacobian(t, z[:count]) @ z[count:].reshape(count, count)
        return np.concatenate([slope(t, z[:count]), tangent.ravel()])

    first = np.concatenate([state, np.eye(count).ravel()])
    done = solve_ivp(extended, (start, end), first, method=method, rtol=tolerance, atol=tolerance)
    if not done.success:
        raise RuntimeError(done.message)
    return done.y[:count, -1], done.y[count:, -1].reshape(count, count)


def divided(
    slope: Field, jacobian: Field, times: np.ndarray, states: np.ndarray, parts: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return times and states with every segment cut into equal parts by integration."""
    fine, points = [], []
    for start, end, state in zip(times[:-1], times[1:], states, strict=True):
        cuts = np.linspace(start, end, parts + 1)
        done = solve_ivp(slope, (start, end), state, method="DOP853", rtol=1e-12, atol=1e-12, t_eval=cuts)
        fine.append(cuts[:-1])
        points.append(done.y[:, :-1].T)
    return np.append(np.concatenate(fine), times[-1]), np.concatenate(points)


def multipliers(transfer: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of the product of the segments' matrices, largest modulus first.

    With two states the smaller one comes from the product of the determinants, which loses no digits.
    """
    product = np.eye(transfer.shape[1])
    for matrix in transfer:
        product = matrix @ product
    if len(product) != 2:
        values = np.linalg.eigvals(product)
        return values[np.argsort(-np.abs(values))]
    determinant, trace = np.prod(np.linalg.det(transfer)), np.trace(product)
    large = (trace + (1.0 if trace >= 0.0 else -1.0) * np.emath.sqrt(trace**2 - 4.0 * determinant)) / 2.0
    return np.array([large, determinant / large])


def shoot(
    slope: Field,
    jacobian: Field,
    times: np.ndarray,
    states: np.ndarray,
    jump: np.ndarray,
    pin: int | None = None,
    tolerance: float = 3e-14,
    method: str = "DOP853",
) -> Orbit:
    """Return the periodic orbit near the given states by one damped Newton iteration over all segments.

    Parameters
    ----------
    slope, jacobian : callable
        y' and its derivative by y, as functions of (t, y).
    times : numpy.ndarray
        Starts of the segments and the end of the last one.
    states : numpy.ndarray
        Guess, one row per segment.
    jump : array_like
        State at the end minus state at the start, such as (2π·winding, 0).
    pin : int, optional
        With it the last state is a constant that is sought, and state `pin` keeps its value at the first start. The
        multipliers are those of the other states.
    tolerance : float
        Relative and absolute tolerance of the integration.
    method : str
        Method of `scipy.integrate.solve_ivp`.
    """
    times, x = np.asarray(times, dtype=float), np.array(states, dtype=float)
    segments, count = x.shape

    def defects(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pairs = [flow(slope, jacobian, times[k], times[k + 1], x[k], tolerance, method) for k in range(segments)]
        g = np.array([end for end, _ in pairs]) - np.vstack([x[1:], x[:1] + jump])
        if pin is not None:
            g[-1, -1] = 0.0
        return g, np.array([matrix for _, matrix in pairs])

    g, transfer = defects(x)
    for _ in range(40):
        a = np.zeros((segments, count, segments, count))
        for k in range(segments):
            a[k, :, k] += transfer[k]
            a[k, :, (k + 1) % segments] -= np.eye(count)
        if pin is not None:
            a[-1, -1] = 0.0
            a[-1, -1, 0, pin] = 1.0
        step = -np.linalg.solve(a.reshape(x.size, x.size), g.ravel()).reshape(x.shape)
        size, share = float(np.abs(step).max()), 1.0
        trial, matrices = defects(x + step)
        while size > 1e-7 and np.abs(trial).max() > (1.0 - 0.1 * share) * np.abs(g).max():
            share /= 2.0
            if share < 1e-3:
                raise RuntimeError("Shooting makes no progress from this guess.")
            trial, matrices = defects(x + share * step)
        x, g, transfer = x + share * step, trial, matrices
        if size <= 1e-12 * max(1.0, np.abs(x).max()):
            inner = transfer if pin is None else transfer[:, :-1, :-1]
            return Orbit(times, x, transfer, multipliers(inner), size)
    raise RuntimeError("Shooting did not converge.")


def trajectory(slope: Field, times: np.ndarray, states: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the states at the times `at`, each segment integrated from its own start; `at` rises inside `times`.

    Without the variational equations the steps are longer: near φ' = 0 the pendulum's friction then costs up to 1e-10.
    """
    at, rows = np.asarray(at, dtype=float), []
    for k, state in enumerate(states):
        last = k == len(states) - 1
        inside = at[(at >= times[k]) & ((at <= times[k + 1]) if last else (at < times[k + 1]))]
        if inside.size:
            span = (times[k], times[k + 1])
            rows.append(solve_ivp(slope, span, state, method="DOP853", rtol=1e-13, atol=1e-13, t_eval=inside).y.T)
    return np.concatenate(rows)


def pendulum_orbit(
    omega: float,
    section: np.ndarray,
    winding: int,
    parts: int = 4,
    tolerance: float = 3e-14,
    method: str = "DOP853",
    **changes: float,
) -> Orbit:
    """Return the orbit near section points at t = 0, T, 2T, … (one per forcing period), `parts` segments per period."""
    slope, jacobian, period = pendulum(omega, **changes)
    section = np.atleast_2d(np.asarray(section, dtype=float))
    times, states = divided(slope, jacobian, period * np.arange(len(section) + 1), section, parts)
    return shoot(slope, jacobian, times, states, [2.0 * np.pi * winding, 0.0], tolerance=tolerance, method=method)


def pendulum_grid(omega: float, section: np.ndarray, tau: np.ndarray, **changes: float) -> np.ndarray:
    """Return (φ, φ') at the forcing periods `tau`, rising from 0, each period integrated from its own section point."""
    slope, _, period = pendulum(omega, **changes)
    return trajectory(slope, period * np.arange(len(section) + 1), np.asarray(section), period * np.asarray(tau))


def pendulum_branch(
    start: float, end: float, step: float, section: np.ndarray, winding: int, parts: int = 2
) -> list[tuple[float, Orbit]]:
    """Return ω and the orbit in steps from `start` to `end`, each guessed from the two before."""
    found: list[tuple[float, Orbit]] = []
    guess = points = np.atleast_2d(section)
    for omega in np.linspace(start, end, 1 + round(abs(end - start) / step)):
        orbit = pendulum_orbit(omega, guess, winding, parts)
        before, points = points, orbit.states[::parts]
        guess = 2.0 * points - before if found else points
        found.append((float(omega), orbit))
    return found


def pendulum_doubling(
    low: float, high: float, section: np.ndarray, winding: int, parts: int = 2, **options: float | str
) -> tuple[float, Orbit]:
    """Return ω between `low` and `high` where a multiplier of the orbit passes −1, and the orbit there."""
    points = np.atleast_2d(section)

    def flip(omega: float) -> float:
        return float(np.prod(1.0 + pendulum_orbit(omega, points, winding, parts, **options).multipliers).real)

    omega = float(brentq(flip, low, high, xtol=1e-13, rtol=1e-14))
    return omega, pendulum_orbit(omega, points, winding, parts, **options)


def pendulum_crossing(
    value: float, rates: tuple[float, float], guess: np.ndarray, winding: int, parts: int = 2, **options: float | str
) -> tuple[float, Orbit]:
    """Return ω and the period-1 orbit with multiplier `value` and φ' at t = 0 between `rates`; folds do no harm.

    The guess is (φ, φ', ω). The states of the orbit are (φ, φ', ω).
    """
    slope, jacobian = pendulum_with_omega()

    def orbit(rate: float) -> Orbit:
        start = np.array([[guess[0], rate, guess[2]]])
        times, states = divided(slope, jacobian, np.array([0.0, 1.0]), start, parts)
        return shoot(slope, jacobian, times, states, [2.0 * np.pi * winding, 0.0, 0.0], pin=1, **options)

    rate = brentq(lambda r: float(np.prod(value - orbit(r).multipliers).real), *rates, xtol=1e-13, rtol=1e-14)
    found = orbit(rate)
    return float(found.states[0, 2]), found


def pendulum_attractor(omega: float, start: np.ndarray, periods: int, skip: int) -> np.ndarray:
    """Return section points of `periods` forcing periods after `skip` periods of plain integration, first φ in ±π."""
    slope, _, period = pendulum(omega)
    at = period * np.arange(skip, skip + periods)
    points = solve_ivp(slope, (0.0, at[-1]), start, method="DOP853", rtol=1e-9, atol=1e-9, t_eval=at).y.T
    points[:, 0] -= 2.0 * np.pi * np.round(points[0, 0] / (2.0 * np.pi))
    return points


def van_der_pol_cycle(
    mu: float, parts: int = 24, tolerance: float = 3e-14, method: str = "DOP853"
) -> tuple[float, float, float]:
    """Return period, x > 0 where x' = 0, and the multiplier other than 1, of van der Pol's limit cycle."""
    slope, jacobian = van_der_pol(mu)
    # The constant third state is 1 here, so that time is plain time; x' = 0 at every half turn.
    done = solve_ivp(
        slope, (0.0, 60.0), [2.0, 0.0, 1.0], method="DOP853", rtol=1e-10, atol=1e-10, events=lambda t, y: y[1]
    )
    turns, points = done.t_events[0], done.y_events[0]
    start = np.array([[abs(points[-1, 0]), 0.0, turns[-1] - turns[-3]]])
    times, states = divided(slope, jacobian, np.array([0.0, 1.0]), start, parts)
    orbit = shoot(slope, jacobian, times, states, np.zeros(3), pin=1, tolerance=tolerance, method=method)
    return float(orbit.states[0, 2]), float(orbit.states[0, 0]), float(orbit.multipliers[1])


# Limit cycle of x'' − μ (1 − x²) x' + x = 0: μ → (period, x > 0 where x' = 0, multiplier other than 1). From a Taylor
# series of order 40 with 36 digits, which is not in this file. `van_der_pol_cycle` agrees to 5e-15 in period and x,
# and in the multiplier to 5e-14 up to μ = 2, then to 5e-13 (μ = 3) and 2e-11 (μ = 5).
VAN_DER_POL = {
    0.1: (6.287111272288727, 2.000103979872796, 0.5330692592096738),
    0.5: (6.380675801773584, 2.002487930447108, 0.03917692025927329),
    1.0: (6.663286859323130, 2.008619860874843, 0.0008596950636038051),
    2.0: (7.629874479674842, 2.019891384667136, 1.273849304439408e-8),
    3.0: (8.859095499719917, 2.023304141682214, 6.989475626079786e-16),
    5.0: (11.61223066771957, 2.021508061562321, 7.738555086859359e-38),
}

# The orbits of the pendulum: DOP853 with rtol = atol = 3e-14 and variational equations, one Newton over all segments,
# four per forcing period (two where ω was sought), down to a step of at most 1e-12 of the largest state.
# Against a Taylor series of order 34 with 32 digits, broken where φ' = 0 and started from these numbers: after one
# period every row meets the next within 2e-12; larger multipliers agree to 1e-11 relative, smaller ones to 1e-10, and
# the −1 and 1 at the critical ω to 4e-13. Against LSODA with three segments per period: rows within 3e-11, multipliers
# to 2e-10 relative, ω of RETURN and FOLD to 1e-12.

# Stable orbits down the cascade from the locked rotation at 13 rad/s: periods 1, 2 and 4.
STABLE = [
    Known(
        13.0,
        1,
        ((-0.386461826143287, 17.08775479148505),),
        ((-0.7161575476738778 - 0.08870549107897023j), (-0.7161575476738777 + 0.08870549107897022j)),
    ),
    Known(
        11.48,
        2,
        ((-0.7773866855154782, 15.303052512062456), (6.175702143318996, 15.870266176652912)),
        (0.7047249482837845, 0.3823492029155595),
    ),
    Known(
        9.6,
        4,
        (
            (-1.6380952031710492, 10.847050790108646),
            (6.534297562795878, 14.629963242481853),
            (11.085654200189872, 11.509094884636378),
            (19.071061598865462, 14.43344821578505),
        ),
        (0.6632673694160652, 0.10714237529074823),
    ),
]

# Where a multiplier passes −1 on the branches of periods 1, 2 and 4, by Brent's method on the product of
# (1 + multiplier). From the stable orbits above down to 9.09 rad/s each branch passes −1 just once, with no fold.
DOUBLINGS = [
    Known(
        11.777800948492088, 1, ((-0.41603297437522047, 16.034809331958158),), (-1.0000000000000009, -0.5194460217215895)
    ),
    Known(
        9.626472743642093,
        2,
        ((-1.5589070309049033, 11.20769394049431), (6.524201379274074, 14.541044031327635)),
        (-0.9999999999999891, -0.26662638125453925),
    ),
    Known(
        9.452278937446584,
        4,
        (
            (-1.7638042574669028, 10.164413401797779),
            (6.53032972124208, 14.721847195603612),
            (11.204876453042983, 11.860748335462192),
            (19.02141684231341, 14.236160034905824),
        ),
        (-1.000000000000092, -0.07091881343706481),
    ),
]

# Far below, the period-1 branch passes −1 once more, back, and then turns in a fold (multiplier 1).
RETURN = Known(
    4.938500543025602, 1, ((-2.5432076531875105, 3.889842566658185),), (-0.9999999999999588, -0.5006075426911923)
)
FOLD = Known(
    4.915146579405625, 1, ((-2.648464711419746, 3.2866306412666386),), (1.0000000000000817, 0.5004562525430042)
)

# Unstable orbits at 9.09 rad/s: the branches of periods 1, 2 and 4, the other rotation of period 1, and four prime
# orbits each of periods 3 and 5, which began as close returns of a chaotic trajectory; so did the rest of those with
# multipliers below 50, of periods 2, 3 and 5.
UNSTABLE = [
    Known(9.09, 1, ((-0.5676230954175046, 13.857121811276961),), (-1.70590040864403, -0.3021074360814437)),
    Known(
        9.09,
        2,
        ((-1.738790029113925, 9.977516934613432), (6.530981638312527, 14.28764479016326)),
        (-2.609047713053087, -0.10180008846405883),
    ),
    Known(
        9.09,
        4,
        (
            (-1.9236080042145265, 9.120359608519388),
            (6.487115128654465, 14.73352259326812),
            (11.341541343896099, 12.089297458467346),
            (18.924266500967832, 13.955857943548438),
        ),
        (-7.068828572869245, -0.009979594703394542),
    ),
    Known(9.09, 1, ((-2.918434670850583, 5.825632505502479),), (11.119076795981467, 0.04634963928408056)),
    Known(
        9.09,
        2,
        (
            (-2.7453205866350916, 4.296048072541958),
            (2.9134129343359243, 2.8943414808233796),
            (5.924533434661318, 11.681708970968627),
        ),
        (-941.3743340323356, -0.0002725575285283573),
    ),
    Known(
        9.09,
        1,
        (
            (1.3017767982348978, -0.762240450436002),
            (-2.257368722074189, 2.353242636145661),
            (3.164791858126283, 4.105313966625098),
        ),
        (-122.77506891268857, -0.0018950249029012344),
    ),
    Known(
        9.09,
        0,
        (
            (-2.711452953781955, 2.9541648428345195),
            (2.065216765615573, -1.311865113633708),
            (-2.8498799905503778, -1.9725350533696433),
        ),
        (1074.3035032595035, 0.0002971684531551172),
    ),
    Known(
        9.09,
        1,
        (
            (-2.6337745810023607, 3.5752668851929412),
            (2.8258089558744106, 2.2939888317099966),
            (3.1468280856585955, 0.13265909023097255),
        ),
        (15933.586725656596, 3.014061474872196e-05),
    ),
    Known(
        9.09,
        3,
        (
            (1.05879708343907, 0.7354357755370896),
            (-1.4220863390239922, 5.360597167477553),
            (4.377137931943775, 10.669139313910955),
            (13.118893486723568, 13.349688478810775),
            (15.901758461264544, 2.308583890927767),
        ),
        (-227.9016230370968, -0.0003245737304103312),
    ),
    Known(
        9.09,
        -2,
        (
            (1.5996574301453137, -11.629895024543996),
            (-6.761768437587533, -13.114341729160618),
            (-9.241356811852627, 0.32008294642050567),
            (-6.199212980965398, 10.01200134563754),
            (-5.276405287234247, -9.248679373760993),
        ),
        (-419.523599424354, -0.00021747828172510988),
    ),
    Known(
        9.09,
        1,
        (
            (1.3249305527915018, -0.9744251199932564),
            (-2.3743490562272322, 1.7219469437987707),
            (2.409792757229967, -0.18800820470498286),
            (-1.4779392509178424, 2.3824274327622104),
            (3.2311504322005837, 3.713057069239143),
        ),
        (1617.961583244552, 5.9566759827580105e-05),
    ),
    Known(
        9.09,
        0,
        (
            (2.9901620117776506, -4.591467617438803),
            (-2.0094249185125177, 1.2289208764068136),
            (2.8747959834568846, 2.0702309125505205),
            (3.534926101984436, 2.871449734892198),
            (8.162541062329137, -1.7756818636680145),
        ),
        (9098.815454703239, 1.1977681555073508e-05),
    ),
    Known(
        9.09,
        0,
        ((1.306016747082223, -1.644889819491003), (-2.5738655804206227, 0.6614696405331335)),
        (-18.038132274277743, -0.023630603378814546),
    ),
    Known(
        9.09,
        0,
        ((2.2599467614703093, -0.9963723887760503), (-2.2599467614703075, 0.9963723887760505)),
        (24.569074569047466, 0.01529274841253079),
    ),
    Known(
        9.09,
        3,
        (
            (-2.206781836774648, 7.630059463551232),
            (6.163105753935997, 15.790297298904283),
            (12.42014048418421, 13.173270701423947),
        ),
        (17.06972584645508, 0.008018972406767834),
    ),
    Known(
        9.09,
        5,
        (
            (-0.5023587094726589, 13.382962343868668),
            (5.273396683380732, 13.173469751349467),
            (12.607274794088825, 13.732932674100772),
            (16.746840426181606, 8.131188379159097),
            (25.160458737747234, 15.428314210751829),
        ),
        (28.160410422553554, 0.0012910303791941597),
    ),
    Known(
        9.09,
        5,
        (
            (-1.7237268441264924, 10.367584590483675),
            (6.60876571777856, 13.987532117554618),
            (10.42870283326311, 7.767592589086254),
            (18.77102510611881, 15.651368071724665),
            (24.866233206639688, 13.322159941005317),
        ),
        (-41.35658616234181, -0.0008790847775340965),
    ),
]


def known(winding: int, omega: float, orbit: Orbit) -> Known:
    """Return an orbit of the pendulum as it stands in the tables."""
    period = 2.0 * np.pi / omega if orbit.states.shape[1] == 2 else 1.0
    tau = orbit.times[:-1] / period
    section = tuple((float(q), float(v)) for q, v in orbit.states[np.abs(tau - np.round(tau)) < 1e-9, :2])
    return Known(float(omega), winding, section, tuple(m.item() for m in orbit.multipliers))


def difference(one: Known, other: Known) -> tuple[float, float, float]:
    """Return the largest differences in ω and section points, and relative in the multipliers."""
    points = np.abs(np.subtract(one.section, other.section)).max()
    relative = np.abs(np.subtract(one.multipliers, other.multipliers) / np.array(one.multipliers)).max()
    return abs(one.omega - other.omega), float(points), float(relative)


def branches() -> tuple[list[Known], list[Known], list[Known]]:
    """Compute STABLE, DOUBLINGS and the unstable orbits of periods 1, 2 and 4 along one cascade down from 13 rad/s."""
    omega, section = 13.0, np.array([[0.0, 13.0]])
    stable, doublings, unstable = [], [], []
    for periods, step, ahead in ((1, 0.1, 0.3), (2, 0.1, 0.03), (4, 0.02, 0.0)):
        section = pendulum_attractor(omega, section[0] + [0.01, 0.0], periods, skip=100 * periods)
        stable.append(known(periods, omega, pendulum_orbit(omega, section, periods)))
        path = pendulum_branch(omega, 9.09, step, np.array(stable[-1].section), periods)
        flips, folds = ([np.prod(v - o.multipliers).real for _, o in path] for v in (-1.0, 1.0))
        passed = [k for k in range(1, len(path)) if flips[k] * flips[k - 1] < 0.0]
        turned = [k for k in range(1, len(path)) if folds[k] * folds[k - 1] < 0.0]
        print(
            f"# period {periods}: {len(path) - 1} steps from {omega:.4f} to 9.09 rad/s; "
            f"a multiplier passes -1 {len(passed)} times and +1 {len(turned)} times"
        )
        for k in passed:
            omega, orbit = pendulum_doubling(path[k][0], path[k - 1][0], path[k][1].states[::2], periods)
            doublings.append(known(periods, omega, orbit))
        unstable.append(known(periods, 9.09, pendulum_orbit(9.09, path[-1][1].states[::2], periods)))
        omega, section = round(doublings[-1].omega - ahead, 2), np.array(doublings[-1].section)
    return stable, doublings, unstable


def main() -> None:
    """Compute all tables again and print them with their differences to those above and to LSODA in other segments."""
    print("VAN_DER_POL = {")
    for mu, values in VAN_DER_POL.items():
        again = van_der_pol_cycle(mu)
        print(f"    {mu}: {again},  # {np.abs(np.divide(again, values) - 1.0).max():.0e} relative")
    print("}")
    stable, doublings, unstable = branches()
    other = {"parts": 3, "tolerance": 1e-13, "method": "LSODA"}
    low, low_again = [], []
    for value, rates, guess in ((-1.0, (3.8, 4.0), (-2.54, 0.0, 4.94)), (1.0, (3.2, 3.35), (-2.65, 0.0, 4.92))):
        low.append(known(1, *pendulum_crossing(value, rates, guess, 1)))
        low_again.append(known(1, *pendulum_crossing(value, rates, guess, 1, **other)))
    # The orbits that are on no branch start from their tabulated points, rounded.
    for k in UNSTABLE[3:]:
        unstable.append(known(k.winding, k.omega, pendulum_orbit(k.omega, np.round(k.section, 3), k.winding)))
    print("# differences (ω, section, relative in multipliers) to the table; to LSODA with three segments per period")
    for name, table, new in (
        ("STABLE", STABLE, stable),
        ("DOUBLINGS", DOUBLINGS, doublings),
        ("RETURN, FOLD", [RETURN, FOLD], low),
        ("UNSTABLE", UNSTABLE, unstable),
    ):
        print(f"{name} = [")
        for index, (old, k) in enumerate(zip(table, new, strict=True)):
            if new is low:
                second = low_again[index]
            else:
                second = known(k.winding, k.omega, pendulum_orbit(k.omega, k.section, k.winding, **other))
            to_table, to_second = (", ".join(f"{d:.0e}" for d in difference(k, one)) for one in (old, second))
            print(f"    # {to_table}; {to_second}\n    {k},")
        print("]")


if __name__ == "__main__":
    main()
