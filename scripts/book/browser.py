"""A headless Chromium for screenshots, driven by the WebDriver protocol (Debian: chromium, chromium-driver). Standard library alone."""

import base64
import json
import subprocess
import time
import urllib.request

SWITCHES = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", "--hide-scrollbars"]


class Browser:
    """One page of one browser; ends the browser when the `with` block is left."""

    def __init__(self, width: int, height: int, dark: bool = False):
        self.driver = subprocess.Popen(["chromedriver", "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        for line in self.driver.stdout:
            if "successfully on port " in line:
                self.port = int(line.split("successfully on port ")[1].strip().rstrip("."))
                break
        switches = [*SWITCHES, f"--window-size={width},{height}"]
        if dark:
            switches.append("--force-dark-mode")
        wanted = {"capabilities": {"alwaysMatch": {"goog:chromeOptions": {"args": switches}}}}
        self.session = self.ask("POST", "/session", wanted)["sessionId"]

    def ask(self, method: str, path: str, body=None):
        data = json.dumps(body if body is not None else {}).encode() if method == "POST" else None
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}{path}", data, {"Content-Type": "application/json"}, method=method)
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)["value"]

    def open(self, address: str):
        self.ask("POST", f"/session/{self.session}/url", {"url": address})

    def run(self, script: str):
        return self.ask("POST", f"/session/{self.session}/execute/sync", {"script": script, "args": []})

    def wait_for(self, script: str, seconds: float = 30.0):
        end = time.monotonic() + seconds
        while not self.run(script):
            if time.monotonic() > end:
                raise TimeoutError(script)
            time.sleep(0.1)

    def screenshot(self) -> bytes:
        return base64.b64decode(self.ask("GET", f"/session/{self.session}/screenshot"))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        try:
            self.ask("DELETE", f"/session/{self.session}")
        finally:
            self.driver.terminate()
            self.driver.wait()
