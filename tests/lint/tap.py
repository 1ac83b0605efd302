"""Prints the results of checks as TAP."""


def report(results):
    """results: pairs of a name and its faults. Returns whether there are any faults."""
    print(f"1..{len(results)}")
    for number, (name, faults) in enumerate(results, 1):
        for fault in faults:
            print(f"# {fault}")
        print(f"{'not ok' if faults else 'ok'} {number} - {name}")
    return any(faults for _, faults in results)
