class InputError(Exception):
    """An input that cannot be used; the message is one line for the user: file, place, what is wrong."""
