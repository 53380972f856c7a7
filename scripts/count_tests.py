#!/usr/bin/python3
"""Counts test cases in ctest's JUnit report and prints "N passed, N failed, N skipped".

Programs that print GoogleTest, pytest or rostest summaries are counted by their cases; any other
program counts as one. Exits non-zero when something failed or nothing ran.

usage: count_tests.py TEST_RESULTS.xml
"""
import re
import sys
import xml.etree.ElementTree as ElementTree


def count(case):
    """(passed, failed, skipped) of one ctest entry."""
    out = case.findtext("system-out") or ""
    status = case.get("status")
    passed = failed = skipped = 0
    if (m := re.search(r"^\[  PASSED  \] (\d+) tests?", out, re.M)):
        passed = int(m.group(1))
        if (s := re.search(r"^\[  SKIPPED \] (\d+) tests?", out, re.M)):
            skipped = int(s.group(1))
        if (f := re.search(r"^\[  FAILED  \] (\d+) tests?", out, re.M)):
            failed = int(f.group(1))
    elif (m := re.search(r"^=+ (.*(?:passed|failed|skipped|error).*) in [\d.]+s", out, re.M)):
        words = dict((w, int(n)) for n, w in re.findall(r"(\d+) (\w+)", m.group(1)))
        passed = words.get("passed", 0)
        failed = words.get("failed", 0) + words.get("error", 0) + words.get("errors", 0)
        skipped = words.get("skipped", 0)
    elif (m := re.search(r"^ \* TESTS: (\d+)\s+ \* ERRORS: (\d+)\s+ \* FAILURES: (\d+)", out, re.M)):
        failed = int(m.group(2)) + int(m.group(3))
        passed = int(m.group(1)) - failed
    elif status == "run":
        passed = 1
    if status == "fail" and failed == 0:
        failed = 1
    elif status not in ("run", "fail"):
        skipped = max(skipped, 1)
    return passed, failed, skipped


def main():
    try:
        cases = list(ElementTree.parse(sys.argv[1]).getroot().iter("testcase"))
    except (OSError, ElementTree.ParseError) as error:
        print(f"count_tests: no test report: {error}", file=sys.stderr)
        print("0 passed, 1 failed")
        return 1
    counts = [count(case) for case in cases]
    passed, failed, skipped = (sum(c[i] for c in counts) for i in range(3))
    for case, c in zip(cases, counts):
        if c[1]:
            print(f"FAILED: {case.get('name')}")
    print(f"{passed} passed, {failed} failed, {skipped} skipped")
    return 0 if failed == 0 and passed > 0 else 1


if __name__ == "__main__":
    sys.exit(main())
