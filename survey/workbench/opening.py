"""What ``labsurvey open`` does: read the project, serve it, and wait until it is interrupted."""

import signal
import webbrowser
from collections.abc import Callable
from pathlib import Path

from survey.workbench.guard import new_token
from survey.workbench.live import Listening
from survey.workbench.server import Server
from survey.workbench.session import Workbench

_ENDINGS = {signal.SIGINT, signal.SIGTERM}


def open_folder(
    folder: Path, host: str, port: int, read_only: bool, browser: bool, say: Callable[[str], None], place: str = ""
) -> None:
    """Serve a project until it is interrupted; place: shown first, such as ``#image=X/hX05``.

    Raises SurveyError for a project that cannot be read, or a port.
    """
    token = new_token()
    server = Server(Workbench(folder, read_only=read_only), token, f"labsurvey_{port}")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDINGS)  # in all threads from here on: this one waits for them
    try:
        with Listening(server, host, port) as listening:
            address = f"{listening.address}#token={token}" + (f"&{place.lstrip('#')}" if place else "")
            print(address, flush=True)
            say("Ctrl-C ends it")
            if browser:
                webbrowser.open(address)
            signal.sigwait(_ENDINGS)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
