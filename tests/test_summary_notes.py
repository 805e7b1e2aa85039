"""Notes of a scene in the summary of a run."""

from types import SimpleNamespace

from tkamb.run.summary import notes_of


def test_a_scene_with_muscles_has_no_note_on_missing_muscles():
    notes = ["Without [muscles] only the quadriceps acts.", "Skin moves."]
    output = SimpleNamespace(notes=notes)
    assert notes_of(SimpleNamespace(output=output, muscles=None)) == notes
    assert notes_of(SimpleNamespace(output=output, muscles=object())) == ["Skin moves."]
