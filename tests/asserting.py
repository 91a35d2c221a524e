"""What the tests of the command line assert again and again."""


def snapshot(folder):
    """Everything in a folder: names and contents."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


def done(result):
    """Assert exit status 0 and a quiet standard error; what was printed."""
    assert (result.exit_code, result.stderr) == (0, ""), (result.stdout, result.stderr, result.exception)
    return result.stdout


def refused(result):
    """Assert one clear line on standard error and exit status 2; the line."""
    assert result.exit_code == 2, (result.stdout, result.stderr, result.exception)
    assert result.stdout == ""
    assert result.stderr.endswith("\n")
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("mcc-jax: error: ")
    assert "Traceback" not in result.stderr
    assert result.stderr.strip().isprintable()
    return result.stderr.strip()


def estimate(value, sd=None):
    """An estimate as results state it."""
    return {"value": value, "sd": sd, "interval_95": None if sd is None else [value - 1.96 * sd, value + 1.96 * sd]}
