//! `cangate scan`: who is on the bus. \[IO\]

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::Exit;
use super::output::{block_on, print_error, stop_on_signal, write_out};
use super::scan_report::{ScanReport, found_node, sighting};
use super::session::{Machine, Session, SessionError, Step, check_company};
use super::tool_args::{ScanArguments, ScanFormat, ScanOptions};
use crate::can::CanFrame;
use crate::can::interface::Interface;
use crate::canopen::NodeId;
use crate::canopen::census::{Census, NodeRecord};
use crate::canopen::probe::{Identity, Probe, ProbeOutput, ProbeSettings};
use crate::mapping::fingerprint::candidates;
use crate::mapping::shipped::SHIPPED;
use crate::time::{Clock, Instant, Now};

/// Scans and prints.
pub(super) fn run(arguments: &ScanArguments) -> Exit {
    block_on(async {
        match survey(&arguments.interface, arguments.options).await {
            Ok(report) => write_out(&text(&report, arguments.format), None),
            Err(exit) => exit,
        }
    })
}

fn text(report: &ScanReport, format: ScanFormat) -> String {
    match format {
        ScanFormat::Table => report.table(),
        // A report is numbers and texts: it can always be written.
        ScanFormat::Json => serde_json::to_string_pretty(report).unwrap_or_default() + "\n",
    }
}

/// A scan of an interface of the host, which SIGINT ends early. Problems are printed.
pub(super) async fn survey(interface: &Interface, options: ScanOptions) -> Result<ScanReport, Exit> {
    let stop = stop_on_signal()?;
    let scanned = match check_company(interface) {
        Ok(()) => scan(interface, options, Clock::start(), stop).await,
        Err(error) => Err(error),
    };
    let (report, end) = scanned.map_err(|error| {
        print_error(&error.to_string());
        error.exit()
    })?;
    if end.nobody_acknowledges {
        print_error(
            "nobody on the bus acknowledges our frames: is the bit rate right, the cable plugged in, a device powered?",
        );
    } else if end.not_sent > 0 {
        print_error(&format!("{} of our frames did not leave; nodes may be missing", end.not_sent));
    } else if report.frames == 0 {
        print_error(
            "no frame was heard: is the bit rate right, the cable plugged in, a device powered? A node that waits for its \
             start sends nothing; --active asks it",
        );
    }
    Ok(report)
}

/// How the asking ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct End {
    not_sent: u32,
    nobody_acknowledges: bool,
}

/// Listens, asks if it may, and tells what was found, also when it was stopped early.
async fn scan(
    interface: &Interface,
    options: ScanOptions,
    clock: Clock,
    stop: CancellationToken,
) -> Result<(ScanReport, End), SessionError> {
    let mut session = Session::open(interface, !options.active, clock, stop).await?;
    let mut survey = Survey::new(clock.now().instant, options);
    let end = match session.run(&mut survey).await {
        Ok(end) => end,
        Err(SessionError::Stopped) => End::default(),
        Err(error) => return Err(error),
    };
    let mut report = ScanReport::of(
        &survey.census,
        session.interface(),
        session.bit_rate(),
        session.overruns(),
        options.active,
    );
    report.nodes = survey.nodes();
    Ok((report, end))
}

/// Listens for a time; then asks, where it may.
struct Survey {
    census: Census,
    identities: BTreeMap<NodeId, Identity>,
    until: Instant,
    ask: Option<Vec<NodeId>>,
    probe: Option<Probe>,
    outputs: VecDeque<Step<End>>,
}

impl Survey {
    fn new(now: Instant, options: ScanOptions) -> Self {
        Self {
            census: Census::default(),
            identities: BTreeMap::new(),
            until: now + Duration::from_secs(options.seconds.into()),
            ask: options.active.then(|| options.nodes.nodes().collect()),
            probe: None,
            outputs: VecDeque::new(),
        }
    }

    fn nodes(&self) -> Vec<super::scan_report::FoundNode> {
        let nothing = NodeRecord::default();
        let ids: BTreeSet<NodeId> = self.census.nodes.keys().chain(self.identities.keys()).copied().collect();
        let nodes = ids.into_iter().filter_map(|id| {
            let record = self.census.nodes.get(&id).unwrap_or(&nothing);
            let identity = self.identities.get(&id);
            // Nodes that we asked, and of which nothing came.
            if !record.is_seen() && identity.is_none() {
                return None;
            }
            let found = candidates(&sighting(id, record, identity), SHIPPED);
            Some(found_node(id, record, identity, found))
        });
        nodes.collect()
    }

    fn drain(&mut self, now: Instant) {
        while let Some(output) = self.probe.as_mut().and_then(Probe::poll_output) {
            match output {
                ProbeOutput::Transmit(frame) => {
                    self.census.handle_sent(now, &frame);
                    self.outputs.push_back(Step::Transmit(frame));
                }
                ProbeOutput::Found(node, identity) => {
                    self.identities.insert(node, identity);
                }
                ProbeOutput::Done { not_sent, nobody_acknowledges } => {
                    self.outputs.push_back(Step::Done(End { not_sent, nobody_acknowledges }));
                }
            }
        }
    }
}

impl Machine for Survey {
    type Output = End;

    fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        self.census.handle_frame(now.instant, frame);
        if let Some(probe) = &mut self.probe {
            probe.handle_frame(now.instant, frame);
        }
        self.drain(now.instant);
    }

    fn handle_not_sent(&mut self, now: Now, frame: &CanFrame) {
        if let Some(probe) = &mut self.probe {
            probe.handle_not_sent(now.instant, frame);
        }
        self.drain(now.instant);
    }

    fn handle_timeout(&mut self, now: Now) {
        if let Some(probe) = &mut self.probe {
            probe.handle_timeout(now.instant);
        } else if now.instant >= self.until {
            match self.ask.take() {
                Some(nodes) => {
                    let told = self.census.nodes.iter().filter(|(_, node)| node.reports.is_some());
                    let known = told.map(|(id, _)| *id).collect();
                    let mut probe = Probe::new(now.instant, nodes, known, ProbeSettings::default());
                    probe.handle_timeout(now.instant);
                    self.probe = Some(probe);
                }
                None => self.outputs.push_back(Step::Done(End::default())),
            }
        }
        self.drain(now.instant);
    }

    fn poll_output(&mut self) -> Option<Step<Self::Output>> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        match &self.probe {
            Some(probe) => probe.poll_timeout(),
            None => Some(self.until),
        }
    }
}

#[cfg(test)]
#[path = "scan_tests.rs"]
mod tests;
