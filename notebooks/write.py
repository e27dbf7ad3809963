"""Write into every notebook what they share: python notebooks/write.py

That is the badge that opens it in Colab and the cell that installs jaxsafe. The address of the
repository stands here alone. `--run NAME` also executes a notebook as it is and stores its outputs.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

REPOSITORY = "https://github.com/jaxsafe/jaxsafe"
HERE = Path(__file__).parent
STORED = ("own_environment",)  # notebooks that keep their outputs; the others take too long to run
BADGE = "[![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)]({address})"
SET_UP = f'''# In Colab this installs jaxsafe for the runtime's device: CPU, GPU or TPU. If Colab then
# asks for a restart, restart and go on. Where jaxsafe is installed already, nothing happens.
import importlib.util
import os
import shutil
from pathlib import Path

REPOSITORY = "{REPOSITORY}"
KEEP_ON_DRIVE = False  # True: runs go to Google Drive and outlast the runtime

if importlib.util.find_spec("jaxsafe") is None:
    gpu = "[gpu]" if shutil.which("nvidia-smi") else ""
    tpu = "jax[tpu]" if "TPU_ACCELERATOR_TYPE" in os.environ or Path("/dev/accel0").exists() else ""
    %pip install -q "jaxsafe{{gpu}} @ git+{{REPOSITORY}}" {{tpu}}
if KEEP_ON_DRIVE:
    from google.colab import drive

    drive.mount("/content/drive")
    os.makedirs("/content/drive/MyDrive/jaxsafe", exist_ok=True)
    os.chdir("/content/drive/MyDrive/jaxsafe")'''


def badge(path: Path) -> str:
    """The line that opens the notebook in Colab."""
    home = REPOSITORY.replace("https://github.com", "https://colab.research.google.com/github")
    return BADGE.format(address=f"{home}/blob/main/notebooks/{path.name}")


def filled(path: Path) -> Any:
    """The notebook with its badge and its set-up cell made anew."""
    notebook: Any = nbformat.read(path, as_version=4)
    title, set_up = notebook.cells[:2]
    lines = [line for line in title.source.splitlines() if not line.startswith("[![Open in Colab]")]
    title.source = "\n".join([lines[0], "", badge(path), *lines[1:]]).replace("\n\n\n", "\n\n")
    set_up.source = SET_UP
    return notebook


def text(notebook: Any) -> str:
    return nbformat.writes(notebook, version=4) + "\n"


def run(notebook: Any) -> None:
    """Execute it in a folder of its own, and keep the outputs but for lines of progress."""
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=600, resources={"metadata": {"path": folder}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times of day
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.output_type != "stream"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", nargs="*", default=[], metavar="NAME", choices=STORED)
    args = parser.parse_args()
    for path in sorted(HERE.glob("*.ipynb")):
        notebook = filled(path)
        if path.stem in args.run:
            run(notebook)
        path.write_text(text(notebook))


if __name__ == "__main__":
    main()
