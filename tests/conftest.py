"""Options of all tests in Python."""


def pytest_addoption(parser):
    parser.addoption("--soak", action="store_true",
                     help="200 kills instead of 20, 200 rounds of faults of a fleet instead of 5")
    parser.addoption("--seed", type=int, default=None,
                     help="seed of the random moments (default: the time)")
