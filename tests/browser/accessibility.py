"""axe-core over a page in the browser: its findings, as the rule, how grave it is, and where."""

import json
import re
from pathlib import Path

import axe_core_python

POLICY = re.compile(r'<meta http-equiv="Content-Security-Policy"[^>]*>')
RUN = """
axe.run(document, {resultTypes: ['violations', 'incomplete']}).then(found => {
  const told = kind => found[kind].map(rule => ({
    id: rule.id, impact: rule.impact, help: rule.help,
    nodes: rule.nodes.slice(0, 5).map(node => node.html.slice(0, 160)),
  }));
  document.body.innerHTML = '<pre id="axe"></pre>';
  document.getElementById('axe').textContent = JSON.stringify({
    violations: told('violations'), incomplete: told('incomplete'), passes: found.passes.length,
  });
});
"""


def findings(browser, html, folder, *flags):
    """What axe-core has to say of a page: violations, what it could not decide, and how many rules passed.

    The page's own policy lets no script run, so a copy without it is opened.
    """
    rules = (Path(axe_core_python.__file__).parent / "axe.min.js").read_text(encoding="utf-8")
    assert "</script" not in rules and len(POLICY.findall(html)) == 1
    copy = POLICY.sub("", html).replace("</body>", f"<script>{rules}</script><script>{RUN}</script></body>")
    file = folder / "with-axe.html"
    file.write_text(copy, encoding="utf-8")
    dom = browser(file, "--virtual-time-budget=60000", "--dump-dom", *flags)
    told = re.search(r'<pre id="axe">(.*?)</pre>', dom, re.S)
    assert told, "axe-core came to no end"
    text = told.group(1).replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    return json.loads(text)
