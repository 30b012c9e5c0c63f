/** The page that opens recordings in Rerun's web viewer. */

const viewer = document.getElementById("viewer");
const about = document.getElementById("about");
const list = document.getElementById("list");

function open({ name, file, text }) {
  const address = new URL(`recordings/${file}`, location.href).href;
  const options = new URLSearchParams({ url: address, hide_welcome_screen: "1" });
  viewer.src = `viewer/index.html?${options}`;
  about.textContent = text;
  for (const button of list.children) {
    button.setAttribute("aria-current", button.dataset.name === name);
  }
  history.replaceState(null, "", `#${name}`);
}

async function main() {
  const answer = await fetch("recordings/recordings.json");
  if (!answer.ok) throw new Error("There are no recordings; `make site` makes them.");
  const recordings = await answer.json();
  for (const recording of recordings) {
    const button = document.createElement("button");
    button.textContent = recording.title;
    button.dataset.name = recording.name;
    button.addEventListener("click", () => open(recording));
    list.append(button);
  }
  const asked = location.hash.slice(1);
  open(recordings.find(({ name }) => name === asked) ?? recordings[0]);
}

main().catch((error) => {
  about.textContent = error.message;
});
