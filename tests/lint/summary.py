#!/usr/bin/python3
"""Adds up JUnit reports: `summary.py REPORT…` lists each failure and ends with `N passed, N
failed`. `summary.py --write REPORT NAME STATUS` writes the report of one step that is not a test
runner."""
import sys
import xml.etree.ElementTree as ET


def write(path, name, status):
    suites = ET.Element("testsuites")
    suite = ET.SubElement(suites, "testsuite", name=name)
    case = ET.SubElement(suite, "testcase", name=name, classname="tools.test")
    if status != 0:
        ET.SubElement(case, "failure", message=f"exit status {status}")
    ET.ElementTree(suites).write(path)


def main(arguments):
    if arguments[:1] == ["--write"]:
        write(arguments[1], arguments[2], int(arguments[3]))
        return 0
    passed = failed = skipped = 0
    for path in arguments:
        for case in ET.parse(path).getroot().iter("testcase"):
            step = path.rsplit("/", 1)[-1][:-4]
            name = f"{step}: {case.get('classname') or ''} {case.get('name')}"
            if case.find("failure") is not None or case.find("error") is not None:
                failed += 1
                print(f"FAILED {name}")
            elif case.find("skipped") is not None:
                skipped += 1
                print(f"skipped {name}: {case.find('skipped').get('message') or 'no reason given'}")
            else:
                passed += 1
    if passed == 0:
        print("FAILED no test ran")
        failed += 1
    print(f"{passed} passed, {failed} failed" + (f", {skipped} skipped" if skipped else ""))
    return failed != 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
