"""`python -m jaxslam.cli`, the same as the `jaxslam` command."""

from jaxslam.cli import main

if __name__ == "__main__":
    main()
