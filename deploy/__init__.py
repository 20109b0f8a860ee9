"""The policy on hardware, or on its digital twin: an arm and a camera behind interfaces, and the loop over them."""

if __name__ != "maniskill_tomato.deploy":
    raise ImportError(
        f"imported as {__name__!r}; import `maniskill_tomato.deploy` instead (is the repository root on sys.path?)"
    )
