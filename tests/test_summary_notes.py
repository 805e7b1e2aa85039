"""Notes of a scene in its run's summary."""

from types import SimpleNamespace

from tkamb.run.summary import notes_of


def test_the_note_on_missing_muscles_goes_when_the_scene_has_them():
    notes = ["Without [muscles] only the quadriceps acts.", "Skin moves."]
    output = SimpleNamespace(notes=notes)
    assert notes_of(SimpleNamespace(output=output, muscles=None)) == notes
    assert notes_of(SimpleNamespace(output=output, muscles=object())) == ["Skin moves."]
