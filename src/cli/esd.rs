//! `cangate esd`: finds modules of esd's protocol, shows them, gives them orders. \[IO\]
//!
//! What stops, resets or changes a module is sent only because an operator typed it (R-ESD-073). Modules confirm nothing, so
//! they are asked afterwards what came of it (R-ESD-054).

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::Exit;
use super::esd_args::EsdArguments;
use super::esd_job::{Answers, Dialogue, Job, Listen, Reply, Search};
use super::esd_report as report;
use super::output::{block_on, print_error, print_line, stop_on_signal};
use super::session::{Session, SessionError, check_company};
use crate::can::interface::Interface;
use crate::can::{BusEvent, CanFrame};
use crate::esd::{Answer, CanStatus, InitCommand, ModuleNumber, Order, Request, Setting};
use crate::time::Clock;

/// How long a frame has to come back from a bus on which it cannot leave, and a module to carry it out.
const SETTLE: Duration = Duration::from_millis(200);
/// An error that is still there may be told once more after it was cleared: so often it is tried (R-ESD-077).
const CLEARINGS: u32 = 3;

/// Why it was not done, or not seen to be done.
#[derive(Debug, thiserror::Error)]
enum EsdError {
    /// The bus.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// Answers could not be told from what somebody else sends.
    #[error(
        "somebody else uses identifier 0x{id:03X} ({frame}); give another one with --reply-id, and stop a gateway that uses this one"
    )]
    Taken {
        /// The identifier.
        id: u16,
        /// What was heard.
        frame: CanFrame,
    },
    /// Questions of a scan did not leave.
    #[error(
        "the scan was given up: its questions do not leave, the bus is overloaded or nobody acknowledges"
    )]
    ScanIncomplete,
    /// It is not there, or starts.
    #[error(
        "module {0} does not answer: is this its number, is it on this bus, at this bit rate? After a reset it is silent for 10 s, \
         unless set otherwise"
    )]
    Silent(ModuleNumber),
    /// The order had no effect.
    #[error("module {module} did not do it: {status}")]
    NotDone {
        /// Which.
        module: ModuleNumber,
        /// What it says.
        status: String,
    },
}

impl EsdError {
    fn exit(&self) -> Exit {
        match self {
            Self::Session(error) => error.exit(),
            Self::Taken { .. } | Self::ScanIncomplete => Exit::Io,
            Self::Silent(_) | Self::NotDone { .. } => Exit::Refused,
        }
    }
}

/// Does what is asked and prints what came of it.
pub(super) fn run(arguments: &EsdArguments) -> Exit {
    let (interface, job) = match arguments.command.job() {
        Ok(job) => job,
        Err(text) => {
            print_error(&text);
            return Exit::Usage;
        }
    };
    block_on(async {
        let stop = match stop_on_signal() {
            Ok(stop) => stop,
            Err(exit) => return exit,
        };
        let done = match check_company(&interface) {
            Ok(()) => perform(&interface, job, Clock::start(), stop).await,
            Err(error) => Err(error.into()),
        };
        match done {
            Ok(lines) => {
                for line in lines {
                    print_line(&line);
                }
                Exit::Ok
            }
            Err(error) => {
                print_error(&error.to_string());
                error.exit()
            }
        }
    })
}

/// What came of it, in lines.
async fn perform(
    interface: &Interface,
    job: Job,
    clock: Clock,
    stop: CancellationToken,
) -> Result<Vec<String>, EsdError> {
    let session = Session::open(interface, false, clock, stop).await?;
    let mut bus = Bus { session, clock };
    if let Some(reply) = job.reply() {
        let listen = &mut Listen::new(clock.now().instant, reply.id);
        if let Some(frame) = bus.session.run(listen).await? {
            return Err(EsdError::Taken { id: reply.id, frame });
        }
    }
    let lines = match job {
        Job::Scan { reply, ask_each } => bus.scan(reply, ask_each).await?,
        Job::Show { module, reply } => bus.show(module, reply).await?,
        Job::Order { module: Some(module), order, reply: Some(reply) } => {
            vec![bus.order_and_see(module, order, reply).await?]
        }
        Job::Order { module, order, reply: _ } => {
            let frame = InitCommand::Supervisor { module, order }.frame();
            bus.send(frame).await?;
            let whom = module.map_or_else(|| "all modules".to_owned(), |module| format!("module {module}"));
            vec![format!("sent to {whom}: {} ({frame}); modules do not confirm it", word(order))]
        }
        Job::Set { module, setting, reply } => bus.set(module, setting, reply).await?,
    };
    bus.session.close().await?;
    Ok(lines)
}

fn word(order: Order) -> &'static str {
    match order {
        Order::Reset => "reset",
        Order::DefaultReset => "default reset",
        Order::Suspend => "suspend",
        Order::Continue => "continue",
        Order::ClearCanError => "clear the CAN error",
        Order::Watchdog => "watchdog",
    }
}

/// Whether a module is as it was told to be.
fn holds(order: Order, status: CanStatus) -> bool {
    match order {
        Order::Suspend => status.is_suspended(),
        Order::Continue => !status.is_suspended(),
        Order::ClearCanError => !status.had_can_error(),
        Order::Reset | Order::DefaultReset | Order::Watchdog => true,
    }
}

/// The bus with the modules.
struct Bus {
    session: Session,
    clock: Clock,
}

impl Bus {
    async fn scan(&mut self, reply: Reply, ask_each: bool) -> Result<Vec<String>, EsdError> {
        let Some(mut search) = Search::new(self.clock.now(), reply, ask_each) else { return Ok(Vec::new()) };
        let (found, complete) = self.session.run(&mut search).await?;
        if !complete {
            return Err(EsdError::ScanIncomplete);
        }
        if found.is_empty() {
            let hint = if ask_each { "" } else { " with news; `--all` finds those without news too" };
            return Ok(vec![format!("no module answers{hint}")]);
        }
        let mut lines = vec![report::HEAD.to_owned()];
        for (module, _) in found {
            // One that has gone meanwhile hides none of the others.
            let row = match self.ask_all(module, reply, &report::ROW, report::row_of_channel).await {
                Ok(answers) => report::row(module, &answers),
                Err(EsdError::Silent(module)) => report::silent_row(module),
                Err(error) => return Err(error),
            };
            lines.push(row);
        }
        Ok(lines)
    }

    async fn show(&mut self, module: ModuleNumber, reply: Reply) -> Result<Vec<String>, EsdError> {
        let answers = self.ask_all(module, reply, &report::MODULE, report::all_of_channel).await?;
        Ok(report::all(module, &answers))
    }

    /// Orders, and sees what came of it.
    async fn order_and_see(
        &mut self,
        module: ModuleNumber,
        order: Order,
        reply: Reply,
    ) -> Result<String, EsdError> {
        let mut left = if order == Order::ClearCanError { CLEARINGS } else { 1 };
        loop {
            self.send(InitCommand::Supervisor { module: Some(module), order }.frame()).await?;
            let answers = self.ask(module, reply, [Request::Status]).await?;
            let told = report::status(&answers);
            let done = match answers.get(&Request::Status) {
                Some(Some(Answer::Status(status))) => holds(order, *status),
                _ => false,
            };
            left -= 1;
            match (done, left) {
                (true, _) => return Ok(format!("module {module}, {}: done; status {told}", word(order))),
                (false, 0) => return Err(EsdError::NotDone { module, status: format!("status {told}") }),
                (false, _) => {}
            }
        }
    }

    /// Sets something, and tells what the module says of it.
    async fn set(
        &mut self,
        module: ModuleNumber,
        setting: Setting,
        reply: Reply,
    ) -> Result<Vec<String>, EsdError> {
        // Nobody would notice that it is not there.
        self.ask(module, reply, [Request::ActiveNumber]).await?;
        self.send(InitCommand::Set { module, setting }.frame()).await?;
        let answers = self.ask(module, reply, [Request::SavedNumber, Request::BitRate]).await?;
        let stored = report::bit_rate(&answers);
        let Setting::BitRate(registers) = setting else {
            return Ok(vec![format!("sent to module {module}: store; stored in it now: bit rate {stored}")]);
        };
        Ok(vec![
            format!("sent to module {module}: {}; stored in it now: {stored}", report::rate_text(registers)),
            "It acts once it is stored (`cangate esd store`) and the module started anew (`cangate esd reset`). Then all other \
             devices and this host's interface must have that bit rate too."
                .to_owned(),
        ])
    }

    /// Asks a module for what it is, then for each of its channels.
    async fn ask_all<const N: usize>(
        &mut self,
        module: ModuleNumber,
        reply: Reply,
        requests: &[Request],
        of_channel: fn(u8) -> [Request; N],
    ) -> Result<Answers, EsdError> {
        let answers = self.ask(module, reply, requests.iter().copied()).await?;
        let channels: Vec<Request> = report::channels(&answers).flat_map(of_channel).collect();
        self.ask_more(module, reply, answers, channels).await
    }

    async fn ask(
        &mut self,
        module: ModuleNumber,
        reply: Reply,
        requests: impl IntoIterator<Item = Request>,
    ) -> Result<Answers, EsdError> {
        self.ask_more(module, reply, Answers::new(), requests).await
    }

    /// Adds to what is known of a module. One that has answered before is there, whatever it does not answer now.
    async fn ask_more(
        &mut self,
        module: ModuleNumber,
        reply: Reply,
        known: Answers,
        requests: impl IntoIterator<Item = Request>,
    ) -> Result<Answers, EsdError> {
        let mut dialogue = Dialogue::new(self.clock.now().instant, module, reply, known, requests);
        let answers = self.session.run(&mut dialogue).await?.map_err(|frame| self.not_sent(frame))?;
        if answers.values().all(Option::is_none) {
            return Err(EsdError::Silent(module));
        }
        Ok(answers)
    }

    async fn send(&mut self, frame: CanFrame) -> Result<(), EsdError> {
        self.session.send(frame)?;
        let deadline = self.clock.now().instant + SETTLE;
        while let Some(event) = self.session.next(deadline).await? {
            if let BusEvent::NotSent { frame, .. } = event {
                return Err(self.not_sent(frame));
            }
        }
        Ok(())
    }

    fn not_sent(&self, frame: CanFrame) -> EsdError {
        SessionError::NotSent { interface: self.session.interface().to_owned(), frame }.into()
    }
}

#[cfg(test)]
#[path = "esd_tests.rs"]
mod tests;
