// Light, dark or red, and the sound of a warning.

const THEMES = ["auto", "light", "dark", "red"];

export function themes(select) {
  const put = name => {
    if (name === "auto") delete document.documentElement.dataset.theme; else document.documentElement.dataset.theme = name;
  };
  const kept = localStorage.getItem("theme");
  select.value = THEMES.includes(kept) ? kept : "auto";
  put(select.value);
  select.onchange = () => { put(select.value); localStorage.setItem("theme", select.value); };
}

// Whether pictures are shown in red alone: an eye that is used to the dark keeps seeing.
export function isRed() { return document.documentElement.dataset.theme === "red"; }

// Tones for what an operator who looks into the microscope has to hear. A browser gives sound after the first click or key only.
export class Sound {
  constructor(box) {
    this.box = box;
    box.checked = localStorage.getItem("sound") !== "off";
    box.onchange = () => { localStorage.setItem("sound", box.checked ? "on" : "off"); if (box.checked) this.play("warning"); };
    this.last = -Infinity;
  }
  play(level) {
    const now = performance.now();
    // A burst of warnings is one sound; a fault is heard in any case.
    if (!this.box.checked || navigator.userActivation?.hasBeenActive === false || (level === "warning" && now - this.last < 2000)) return;
    this.last = now;
    try {
      this.context ??= new AudioContext();
      if (this.context.state !== "running") { this.context.resume(); }
      const tones = level === "fault" ? [880, 660, 880, 660, 880] : [660];
      tones.forEach((hz, n) => {
        const tone = this.context.createOscillator(), gain = this.context.createGain();
        const from = this.context.currentTime + 0.18 * n;
        tone.frequency.value = hz;
        gain.gain.setValueAtTime(0, from);
        gain.gain.linearRampToValueAtTime(0.2, from + 0.01);
        gain.gain.linearRampToValueAtTime(0, from + 0.15);
        tone.connect(gain).connect(this.context.destination);
        tone.start(from); tone.stop(from + 0.16);
      });
      this.played = (this.played ?? 0) + 1;
    } catch { /* a browser without sound */ }
  }
}
