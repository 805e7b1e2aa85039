"""Body and contact brought to agree: `contact_side` is the only file that sees both."""
