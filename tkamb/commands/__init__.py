"""The commands of `tkamb`: arguments in, exit status out; nothing is computed here."""
