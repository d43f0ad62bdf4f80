"""The command line as ``python -m inflight``, for an environment whose scripts are not on the path."""

from inflight.cli import main

if __name__ == "__main__":
    main()
