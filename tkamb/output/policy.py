"""Content security policy of pages that stand by themselves: only their own scripts run."""

import base64
import hashlib


def sources(*texts: str) -> str:
    """Return the sources of inline scripts or styles for a policy: "'sha256-…' 'sha256-…'".

    Args:
        texts: what stands between the tags, each whole. A browser reads line ends as \\n before
            it hashes.

    Reference: W3C, Content Security Policy Level 3, section 2.3.1.
    """
    return " ".join(f"'sha256-{_digest(text)}'" for text in texts)


def _digest(text: str) -> str:
    normal = text.replace("\r\n", "\n").replace("\r", "\n")
    return base64.b64encode(hashlib.sha256(normal.encode()).digest()).decode()
