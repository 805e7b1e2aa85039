"""One frame as a contact problem for other programs: CalculiX and FEBio."""
