//! `cangate lss`: finds devices by their address, gives them node ids and bit rates. \[IO\]

use tokio_util::sync::CancellationToken;

use super::Exit;
use super::lss_args::{LssArguments, LssCommand};
use super::lss_job::LssTask;
use super::output::{block_on, print_error, print_line, stop_on_signal};
use super::session::{Session, SessionError, check_company};
use crate::can::interface::Interface;
use crate::canopen::lss::{LssAddress, LssAnswer, LssError, LssJob, LssKnown, LssState};
use crate::time::Clock;

/// Does what is asked and prints what came of it.
pub(super) fn run(arguments: &LssArguments) -> Exit {
    let task = match task(arguments) {
        Ok(task) => task,
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
        let done = match check_company(&arguments.interface) {
            Ok(()) => perform(&arguments.interface, task, Clock::start(), stop).await,
            Err(error) => Err(error),
        };
        match done {
            Ok(Ok(answers)) => {
                for line in told(&arguments.command, &answers) {
                    print_line(&line);
                }
                Exit::Ok
            }
            Ok(Err(error)) => {
                print_error(&error.to_string());
                if error == LssError::BusUnavailable { Exit::Io } else { Exit::Refused }
            }
            Err(error) => {
                print_error(&error.to_string());
                error.exit()
            }
        }
    })
}

/// What is to be done, from what was typed.
fn task(arguments: &LssArguments) -> Result<LssTask, String> {
    let leave = LssJob::SwitchGlobal { state: LssState::Waiting, only_slave: false };
    let jobs = match &arguments.command {
        LssCommand::Scan { known } => match known.range() {
            Some(range) => vec![LssJob::Slowscan(vec![range])],
            None if known.is_empty() => vec![LssJob::Fastscan(LssKnown::default()), leave],
            None => {
                return Err("to find configured devices give --vendor and --product, which their data sheet or a nameplate \
                            tells; without both only unconfigured devices are found"
                    .to_owned());
            }
        },
        LssCommand::Inquire { address, only_one_device } => {
            let switch = match address.address()? {
                Some(address) => LssJob::SwitchSelective(address),
                None if *only_one_device => {
                    LssJob::SwitchGlobal { state: LssState::Configuration, only_slave: true }
                }
                None => return Err(LssError::NotConfirmed.to_string() + WHICH),
            };
            vec![switch, LssJob::InquireAddress, LssJob::InquireNodeId, leave]
        }
        LssCommand::SetNodeId { change, to, bit_rate } => {
            return change.task(Some(*to), *bit_rate);
        }
        LssCommand::SetBitRate { change, bit_rate } => return change.task(None, Some(*bit_rate)),
        LssCommand::SwitchWaiting => vec![leave],
    };
    Ok(LssTask::new(jobs))
}

/// How to say which device is meant.
pub(super) const WHICH: &str = ": --vendor, --product, --revision and --serial, or --only-one-device";

async fn perform(
    interface: &Interface,
    mut task: LssTask,
    clock: Clock,
    stop: CancellationToken,
) -> Result<Result<Vec<LssAnswer>, LssError>, SessionError> {
    // A signal does not end the session: a device must not be left stopped, or in configuration state.
    let mut session = Session::open(interface, false, clock, CancellationToken::new()).await?;
    task.begin(clock.now().instant);
    let result = tokio::select! {
        done = session.run(&mut task) => done?,
        () = stop.cancelled() => {
            task.cancel(clock.now().instant);
            session.run(&mut task).await?
        }
    };
    // A last frame has still to leave; the result says already what counts.
    let _ = session.close().await;
    Ok(result)
}

/// What is printed after a success.
fn told(command: &LssCommand, answers: &[LssAnswer]) -> Vec<String> {
    let mut lines = Vec::new();
    for answer in answers {
        match answer {
            LssAnswer::Done => {}
            LssAnswer::Address(address) => lines.push(options(address)),
            LssAnswer::NodeId(Some(node)) => lines.push(format!("node id {node}")),
            LssAnswer::NodeId(None) => lines.push("no node id".to_owned()),
            LssAnswer::Answered(yes) => lines.push(if *yes { "yes" } else { "no" }.to_owned()),
            LssAnswer::Found(found) if found.is_empty() => lines.push(nobody(command).to_owned()),
            LssAnswer::Found(found) => lines.extend(found.iter().map(options)),
            LssAnswer::Changed { active, restored } => lines.extend(changed(*active, *restored)),
        }
    }
    if matches!(command, LssCommand::SwitchWaiting) {
        lines.push("all LSS slaves are told to leave configuration state; they do not confirm it".to_owned());
    }
    lines
}

fn nobody(command: &LssCommand) -> &'static str {
    match command {
        LssCommand::Scan { known } if known.is_empty() => {
            "no unconfigured device answered; to find those that have a node id give --vendor and --product"
        }
        LssCommand::Scan { .. }
        | LssCommand::Inquire { .. }
        | LssCommand::SetNodeId { .. }
        | LssCommand::SetBitRate { .. }
        | LssCommand::SwitchWaiting => {
            "no device of this address answered; some answer only while they are stopped: `cangate nmt stop NODE`"
        }
    }
}

/// An address as it can be typed again.
fn options(address: &LssAddress) -> String {
    let LssAddress { vendor, product, revision, serial } = address;
    format!("--vendor 0x{vendor:X} --product 0x{product:X} --revision 0x{revision:X} --serial {serial}")
}

fn changed(active: bool, restored: bool) -> Vec<String> {
    let mut lines = vec![if active {
        "stored and in effect: the node has booted with its new id".to_owned()
    } else {
        "stored; it takes effect when the device is switched off and on. Where the bit rate changed, all other devices and \
         this host's interface must follow"
            .to_owned()
    }];
    if !restored {
        lines.push(
            "the NMT states or the heartbeat time from before could not be restored: look with `cangate scan`".to_owned(),
        );
    }
    lines
}

#[cfg(test)]
#[path = "lss_tests.rs"]
mod tests;
