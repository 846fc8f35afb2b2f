"""`python -m bayescal`: the command line."""

from bayescal._cli.main import main

if __name__ == "__main__":
    main()
