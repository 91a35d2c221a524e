"""Print the coefficients in `mcc_jax/formulas/contact.py`.

Run `uv run --group test python benchmarks/make_recovery_coefficients.py`.

Chebyshev interpolation with 50 digits of
  P(u) = f / u^(3/2),  f = (2/pi)(acos s - s sqrt(1 - s^2)),  u = 1 - s,
  S(w) = s / (1 - w),  w = f^(2/3),
  R(u) = g / u^(5/2),  g = integral of f from s to 1,
all analytic on [0, 1], then expanded in powers of z = 2u - 1 and z = 2w - 1. Near the ends f is evaluated with the 60
digits that the cancellation in acos s - s sqrt(1 - s^2) needs.
"""

from mpmath import mp, mpf

mp.dps = 60


def ratio(u):
    """F(u) = stress over peak stress at u = 1 - s."""
    s = 1 - u
    return 2 / mp.pi * (mp.acos(s) - s * mp.sqrt(u * (2 - u)))


def P(u):
    return ratio(u) / u ** mpf("1.5") if u > mpf(10) ** -25 else 8 * mp.sqrt(2) / (3 * mp.pi)


def R(u):
    if u < mpf(10) ** -8:  # the bracket below loses u^(5/2); the integral of u^(3/2) P(0) is exact to u there
        return mpf(2) / 5 * P(mpf(0)) * (1 - mpf(3) / 28 * u)
    s = 1 - u
    root = mp.sqrt(u * (2 - u))
    return 2 / mp.pi * (root - s * mp.acos(s) - root**3 / 3) / u ** mpf("2.5")


def S(w):
    if w < mpf(10) ** -25:
        return mpf(1)
    if w > 1 - mpf(10) ** -25:
        return mpf(3) * mp.pi / 8  # f = 1 - (4/pi) s and w = 1 - (2/3)(4/pi) s to first order
    target = w ** mpf("1.5")
    guess = w * P(mpf(0)) ** (-mpf(2) / 3)
    bracket = (guess * mpf("0.97"), min(guess * mpf("1.03"), mpf(1)))
    return (1 - mp.findroot(lambda v: ratio(v) - target, bracket, solver="secant")) / (1 - w)


def interpolate(function, degree):
    """Coefficients in powers of z on [-1, 1], highest first, of the interpolant of `function((1 + z) / 2)`."""
    n = degree + 1
    nodes = [mp.cos(mp.pi * (2 * k + 1) / (2 * n)) for k in range(n)]
    values = [function((1 + z) / 2) for z in nodes]
    angles = [mp.pi * (2 * k + 1) / (2 * n) for k in range(n)]
    cheb = [2 / mpf(n) * sum(v * mp.cos(j * t) for v, t in zip(values, angles, strict=True)) for j in range(n)]
    cheb[0] /= 2
    # Clenshaw on polynomials: T_j expanded in powers of z.
    previous, current = [mpf(1)], [mpf(0), mpf(1)]
    power = [mpf(0)] * n
    for j in range(n):
        polynomial = previous if j == 0 else current
        for i, c in enumerate(polynomial):
            power[i] += cheb[j] * c
        if j >= 1:
            following = [mpf(0)] + [2 * c for c in current]
            for i, c in enumerate(previous):
                following[i] -= c
            previous, current = current, following
    return power[::-1]


def largest_relative_error(function, coefficients):
    """Of the polynomial itself, before rounding of its evaluation."""
    worst = mpf(0)
    for k in range(2001):
        x = mpf(k) / 2000
        z = 2 * x - 1
        value = mpf(0)
        for c in coefficients:
            value = value * z + c
        worst = max(worst, abs(value / function(x) - 1))
    return worst


def table(name, function, degree):
    coefficients = interpolate(function, degree)
    error = largest_relative_error(function, coefficients)
    numbers = [repr(float(c)) for c in coefficients]
    rows = (", ".join(numbers[k : k + 4]) for k in range(0, len(numbers), 4))
    lines = "".join(f"    {row},\n" for row in rows)
    return f"{name} = (  # degree {degree}, largest relative error {mp.nstr(error, 2)}\n{lines})"


def main():
    for name, function, degree in (
        ("RATIO_64", P, 17),
        ("RATIO_32", P, 7),
        ("ENERGY_64", R, 17),
        ("RECOVERY_64", S, 23),
        ("RECOVERY_32", S, 9),
    ):
        print(table(name, function, degree))


if __name__ == "__main__":
    main()
