"""What of a case is possible but unlikely: questions, each with the likely mistake."""
