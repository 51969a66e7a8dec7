"""What every complaint about a file has in common."""

from ssmail.errors import InputError


def sentence_of(error: InputError, file: str) -> str:
    """One printable sentence, not too long, that begins with the name of the file."""
    sentence = str(error)
    assert sentence.startswith(file)
    assert sentence.isprintable()
    assert len(sentence) < 250
    return sentence
