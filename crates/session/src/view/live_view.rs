//! The page and the screen of a command that holds a rig.

use super::hello::{Page, hello};
use super::last_word;
use super::pictures::Pictures;
use super::possible::Possible;
use super::served::{Server, ViewAddress, serve};
use super::watcher::Watcher;
use crate::clips;
use crate::failure::Failure;
use crate::rig::Rig;
use crate::screen::{Screen, ScreenConfig};
use crate::setup::Setup;
use cellpos_live::{Feed, Film, Hello, OperatorRequest};
use cellpos_rig::FrameWatch;
use cellpos_runtime::Request;
use cellpos_runtime::live::Operator;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Most frames of a clip on the page: half a second of a fast camera.
const FILM_FRAMES: usize = 250;

/// The ways to show a run.
#[derive(Debug, Clone, Default)]
pub struct Wanted {
    /// The page in a browser.
    pub page: Option<ViewAddress>,
    /// The whole terminal.
    pub screen: Option<ScreenConfig>,
}

impl Wanted {
    /// Whether the run is shown at all.
    pub fn is_any(&self) -> bool {
        self.page.is_some() || self.screen.is_some()
    }
}

/// Receiver of the operator's requests: the present run, or the last one.
type Addressee = Arc<Mutex<Arc<Operator>>>;

/// Shows a run, or several one after the other.
pub struct View {
    // Fields are dropped in this order: the terminal is released before further output.
    screen: Option<Screen>,
    server: Option<Server>,
    pub(super) watcher: Option<Watcher>,
    pub(super) notes: Option<Receiver<String>>,
    pictures: (Sender<Pictures>, Receiver<Pictures>),
    addressee: Addressee,
    run: Arc<OnceLock<PathBuf>>,
}

impl View {
    /// Shows the next run on a rig: its frames are shown, and its operator takes the requests.
    ///
    /// # Errors
    /// The address cannot be used, or other machines could reach it although the user did not request that.
    pub fn of(wanted: &Wanted, rig: &mut Rig, setup: &Setup, page: &Page) -> Result<Self, Failure> {
        let mut view = Self::open(wanted, hello(rig, setup, page), rig.operator())?;
        let diffusion = crate::fit::diffusion_um2_per_s(rig.file(), &setup.model);
        view.watcher = (view.watcher).map(|it| it.with_possible(Possible::new(setup, diffusion)));
        view.follow(rig);
        Ok(view)
    }

    /// Shows a run whose data the caller fills in. The operator's requests go to `operator`.
    ///
    /// # Errors
    /// As [`View::of`].
    pub fn open(wanted: &Wanted, hello: Hello, operator: &Arc<Operator>) -> Result<Self, Failure> {
        let (noted, notes) = channel();
        let addressee: Addressee = Arc::new(Mutex::new(Arc::clone(operator)));
        let run = Arc::new(OnceLock::new());
        let pictures = channel();
        let adaptation_at = hello.adaptation_at;
        let mut feeds = vec![];
        let mut server = None;
        if let Some(at) = wanted.page {
            let (mut feed, hub) = Feed::new(hello.clone());
            if let Some(feed) = feed.take_pictures() {
                // The same value holds the other end.
                let _ = pictures.0.send(Pictures::new(feed));
            }
            let asked = Arc::clone(&addressee);
            let act = move |command| act(command, &asked, &noted);
            server = Some(serve(at, film(&run), hub, act)?);
            feeds.push(feed);
        }
        let mut screen = None;
        if let Some(config) = &wanted.screen {
            // The screen has no pictures: its messages are lines.
            let without = Hello {
                pictures: false,
                ..hello
            };
            let (feed, hub) = Feed::new(without);
            screen = Some(Screen::open(config, hub).map_err(Failure::failed)?);
            feeds.push(feed);
        }
        Ok(Self {
            screen,
            server,
            watcher: Some(Watcher::new(feeds).with_adaptation(adaptation_at)),
            notes: Some(notes),
            pictures,
            addressee,
            run,
        })
    }

    /// Switches to the next run on a rig. A stop request in between applies to it too.
    pub fn follow(&mut self, rig: &mut Rig) {
        let operator = Arc::clone(rig.operator());
        let mut addressee = lock(&self.addressee);
        let asked = addressee.asked();
        if !Arc::ptr_eq(&addressee, &operator) && asked != Request::None {
            operator.ask(asked);
        }
        *addressee = operator;
        drop(addressee);
        if let Some(pictures) = self.pictures() {
            rig.watch(pictures);
        }
    }

    /// The source of its frames, unless another camera has it.
    pub fn pictures(&mut self) -> Option<Box<dyn FrameWatch>> {
        let pictures = self.pictures.1.try_recv().ok()?;
        Some(pictures.lend(&self.pictures.0))
    }

    /// The folder of the run, for requests of its clips.
    pub fn recorded_in(&self, run: &Path) {
        let _ = self.run.set(run.to_owned());
    }

    /// The links, to be printed; none without a page.
    pub fn links(&self) -> Option<String> {
        let server = self.server.as_ref()?;
        Some(format!(
            "live page, to act:  {}\nlive page, to look: {}",
            server.operator_url(),
            server.viewer_url()
        ))
    }

    /// The links of operator and viewer; none without a page.
    pub fn urls(&self) -> Option<[String; 2]> {
        let server = self.server.as_ref()?;
        Some([server.operator_url(), server.viewer_url()])
    }

    /// Whether other machines can reach its page.
    pub fn is_reachable(&self) -> bool {
        let server = self.server.as_ref();
        server.is_some_and(|server| !server.address().ip().is_loopback())
    }

    /// Whether the screen uses the whole terminal.
    pub fn has_screen(&self) -> bool {
        self.screen.is_some()
    }
}

/// Shows several runs of a command, one after the other, on one page.
pub struct Pages {
    wanted: Wanted,
    page: Page,
    said: fn(&View),
    view: Option<View>,
}

impl Pages {
    /// Shows nothing before the first run; then calls `said`.
    pub fn new(wanted: Wanted, page: Page, said: fn(&View)) -> Self {
        Self {
            wanted,
            page,
            said,
            view: None,
        }
    }

    /// Shows the next run on a rig; `None`: no view was requested.
    ///
    /// # Errors
    /// As [`View::of`].
    pub fn next(&mut self, rig: &mut Rig, setup: &Setup) -> Result<Option<&mut View>, Failure> {
        if !self.wanted.is_any() {
            return Ok(None);
        }
        if let Some(view) = &mut self.view {
            view.follow(rig);
        } else {
            let view = View::of(&self.wanted, rig, setup, &self.page)?;
            (self.said)(&view);
            self.view = Some(view);
        }
        Ok(self.view.as_mut())
    }

    /// Ends the series for a reason in a sentence; also states whether everything was done.
    pub fn over(&mut self, done: bool, reason: &str) {
        if let Some(watcher) = self.view.as_mut().and_then(|view| view.watcher.as_mut()) {
            let how = if done { "done" } else { "stopped" };
            watcher.over(last_word::of_reason(how, reason));
        }
    }
}

/// The clips of a run folder that is not known yet.
fn film(run: &Arc<OnceLock<PathBuf>>) -> Film {
    let run = Arc::clone(run);
    Arc::new(move |name| film_of(run.get()?, name))
}

/// A clip of a run folder, as the page takes it.
pub(super) fn film_of(run: &Path, name: &str) -> Option<Vec<u8>> {
    let film = clips::read(run, name, FILM_FRAMES).ok()?;
    Some(film.to_bytes())
}

fn lock(addressee: &Addressee) -> std::sync::MutexGuard<'_, Arc<Operator>> {
    addressee.lock().unwrap_or_else(PoisonError::into_inner)
}

fn act(command: OperatorRequest, addressee: &Addressee, noted: &Sender<String>) {
    let operator = lock(addressee);
    match command {
        // A freeze does not end the run: the operator may want to continue.
        OperatorRequest::Freeze | OperatorRequest::Pause => {
            let _ = operator.change(Request::None, Request::Pause)
                || operator.change(Request::Skip, Request::Pause);
        }
        OperatorRequest::Resume => {
            let _ = operator.change(Request::Pause, Request::None);
        }
        OperatorRequest::Park => operator.ask(Request::Park),
        OperatorRequest::Skip => {
            let _ = operator.change(Request::None, Request::Skip)
                || operator.change(Request::Pause, Request::Skip);
        }
        OperatorRequest::Target { um } => operator.steer(um),
        // The run is over and takes no more notes.
        OperatorRequest::Note { text } => drop(noted.send(text)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_freeze_or_a_skip_on_the_page_never_undoes_a_stop() {
        let operator = Arc::new(Operator::default());
        let addressee: Addressee = Arc::new(Mutex::new(Arc::clone(&operator)));
        let (noted, _notes) = channel();
        let ask = |command| {
            act(command, &addressee, &noted);
            operator.asked()
        };
        assert_eq!(ask(OperatorRequest::Freeze), Request::Pause);
        assert_eq!(ask(OperatorRequest::Resume), Request::None);
        assert_eq!(ask(OperatorRequest::Park), Request::Park);
        for command in [
            OperatorRequest::Freeze,
            OperatorRequest::Resume,
            OperatorRequest::Skip,
        ] {
            assert_eq!(ask(command), Request::Park);
        }
    }
}
