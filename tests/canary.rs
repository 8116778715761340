//! Secrets with marks in them, in every place that takes one, right and wrong: the marks are found in no log, message, page,
//! topic or file (IEC 62443-4-2, CR 1.5 and 1.7).

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::net::SocketAddr;
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use cangate::access::PasswordHash;
use cangate::config;
use cangate::mapping::SourceText;
use cangate::tls::TlsClientSettings;
use cangate::web::server::ROUTES;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::json;
use tokio::net::TcpStream;

use crate::support::http::{Answer, converse};
use crate::support::mosquitto::Probe;
use crate::support::pki::{Authority, Folder};
use crate::support::ports::free_address;
use crate::support::secure_web::connect;
use crate::support::{PATIENCE, until};

const MQTT: &str = "cAnArY-mqtt-password";
const TOKEN: &str = "cAnArY-token-0123456789";
const PASSWORD: &str = "cAnArY-login-password";
const TYPO: &str = "cAnArY-mistyped-password";
/// Is no secret, and is in every log: were it not found, nothing would be.
const SHOWN: &str = "birdcage";

/// Everything that a run says.
#[derive(Default)]
struct Said(BTreeMap<String, Vec<u8>>);

impl Said {
    fn add(&mut self, place: impl Into<String>, text: impl Into<Vec<u8>>) {
        self.0.entry(place.into()).or_default().extend(text.into());
    }

    fn add_output(&mut self, place: &str, output: &Output) {
        self.add(format!("{place}: stdout"), output.stdout.clone());
        self.add(format!("{place}: stderr"), output.stderr.clone());
    }

    fn add_answer(&mut self, place: &str, answer: &Answer) {
        // A cookie is for the browser that just logged in.
        let head = answer.head.lines().filter(|line| !line.starts_with("set-cookie"));
        self.add(place, head.collect::<String>() + &answer.body);
    }

    /// Where one of the marks stands, in whatever letters, as text, as hexadecimal digits, or as a list of bytes.
    fn found(&self, marks: &[String]) -> Vec<String> {
        let mut found = Vec::new();
        for (place, text) in &self.0 {
            let text = String::from_utf8_lossy(text).to_lowercase();
            for mark in marks {
                let bytes = mark.as_bytes();
                let hexadecimal = bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().concat();
                let list: Vec<String> = bytes.iter().map(u8::to_string).collect();
                let forms = [mark.to_lowercase(), hexadecimal, list.join(", "), list.join(",")];
                if let Some(at) = forms.iter().find_map(|form| text.find(form.as_str())) {
                    let around: String = text[..at].chars().rev().take(120).collect();
                    let before: String = around.chars().rev().collect();
                    found.push(format!(
                        "{place}: {before}>>> {}",
                        text[at..].chars().take(120).collect::<String>()
                    ));
                }
            }
        }
        found
    }

    #[track_caller]
    fn assert_silent(&self, marks: &[String]) {
        let found = self.found(marks);
        assert!(found.is_empty(), "{} secrets are told:\n{}", found.len(), found.join("\n"));
    }
}

/// A program that does not outlive its test.
struct Running(Child);

impl Running {
    fn stop(mut self) {
        let _ = kill(Pid::from_raw(self.0.id().try_into().unwrap()), Signal::SIGTERM);
        let _ = self.0.wait();
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// An installation with a secret in every place that takes one.
struct Plant {
    folder: Folder,
    authority: Authority,
    /// Where the gateway works and writes.
    work: PathBuf,
    http: SocketAddr,
    marks: Vec<String>,
    text: String,
    hash: PasswordHash,
}

impl Plant {
    fn new(broker: SocketAddr) -> Self {
        let (folder, authority) = (Folder::new(), Authority::new("plant"));
        let pair = authority.host();
        folder.write_pair("gateway", &pair);
        folder.write("ca.pem", &authority.pem);
        let hash = PasswordHash::of(PASSWORD, *b"salt-for-canary!").unwrap();
        folder.write("mqtt", &format!("{MQTT}\n"));
        folder.write("token", &format!("{TOKEN}\n"));
        folder.write("maria", hash.as_str());
        let work = folder.path("work");
        fs::create_dir(&work).unwrap();
        let key = pair.key.lines().filter(|line| !line.starts_with("-----")).map(str::to_owned);
        let mut marks: Vec<String> = key.collect();
        assert!(marks.len() > 1, "a key of several lines");
        marks.push("cAnArY".to_owned());
        marks.extend(hash.as_str().rsplit('$').take(2).map(str::to_owned));
        let (http, modbus) = (free_address(), free_address());
        let file = |name: &str| folder.path(name).display().to_string();
        let (cert, key, ca) = (file("gateway.pem"), file("gateway.key"), file("ca.pem"));
        let text = format!(
            "version = 1\n[gateway]\nname = \"{SHOWN}\"\n[bus.b]\ninterface = \"virtual:birds\"\n\
             [node.engine1]\nbus = \"b\"\nid = 1\nmapping = \"motortech-detcon\"\n\
             [modbus]\nlisten = [\"{modbus}\"]\n[modbus.security]\nlisten = [\"127.0.0.1:0\"]\n\
             cert_file = \"{cert}\"\nkey_file = \"{key}\"\nclient_ca_file = \"{ca}\"\nno_role = [\"read\"]\n\
             [http]\nlisten = \"{http}\"\nread = \"viewer\"\n[http.tls]\ncert_file = \"{cert}\"\nkey_file = \"{key}\"\n\
             [mqtt]\nurl = \"mqtt://{broker}\"\nusername = \"gateway\"\npassword_file = \"{}\"\n\
             reconnect_max_s = 1\nbuffer_dir = \"{}\"\n\
             [access.jo]\nrole = \"operator\"\npassword = \"{}\"\n[access.maria]\nrole = \"viewer\"\npassword_file = \"{}\"\n\
             [access.scada]\nrole = \"engineer\"\nmqtt = true\ntoken_file = \"{}\"\n",
            file("mqtt"),
            work.join("buffer").display(),
            hash.as_str(),
            file("maria"),
            file("token"),
        );
        Self { folder, authority, work, http, marks, text, hash }
    }

    /// The program, in its folder.
    fn program(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cangate"));
        command.env_clear().current_dir(&self.work).stdin(Stdio::null()).arg("--log=trace");
        command
    }

    fn config(&self, text: &str) -> String {
        self.folder.write("cangate.toml", text).display().to_string()
    }

    fn run(&self, file: &str, variables: &[(OsString, OsString)]) -> Running {
        let log = |name: &str| fs::File::create(self.work.join(name)).unwrap();
        let mut command = self.program();
        command.args(["run", "-c", file]).envs(variables.iter().cloned());
        Running(command.stdout(log("stdout")).stderr(log("log")).spawn().unwrap())
    }

    async fn ask(&self, line: &str, headers: &str, body: &str) -> Option<Answer> {
        TcpStream::connect(self.http).await.ok()?;
        let ca_file = Some(self.folder.path("ca.pem"));
        let files = TlsClientSettings { ca_file, ..TlsClientSettings::default() };
        let stream = connect(self.http, files).await.ok()?;
        Some(converse(stream, line, headers, body).await)
    }

    /// Asks for everything that there is, with right and wrong logins.
    async fn exercise(&self, said: &mut Said) {
        const JSON: &str = "Content-Type: application/json\r\n";
        let login = |name: &str, password: &str| json!({"name": name, "password": password}).to_string();
        let token = format!("Authorization: Bearer {TOKEN}\r\n");
        let mut heard = async |line: &str, headers: &str, body: &str| {
            let answer = self.ask(line, headers, body).await.expect("the gateway answers");
            said.add_answer(line, &answer);
            answer
        };
        for (name, password) in [("jo", TYPO), (TYPO, PASSWORD)] {
            heard("POST /api/v1/login", JSON, &login(name, password)).await;
        }
        heard("POST /api/v1/login", JSON, &format!("{{\"password\":\"{TYPO}")).await;
        heard("GET /metrics", &format!("Authorization: Bearer {TYPO}\r\n"), "").await;
        let session = heard("POST /api/v1/login", JSON, &login("jo", PASSWORD)).await;
        let cookie = if session.code == 200 { session.cookie() } else { String::new() };
        let ours = "Origin: https://localhost\r\n";
        for headers in [&token, &format!("{cookie}{ours}")] {
            heard("POST /api/v1/commands/acknowledge_all", &format!("{JSON}{headers}"), "{}").await;
            heard("POST /api/v1/commands/reset", &format!("{JSON}{headers}"), "{\"alarm\":\"x\"}").await;
            for route in ROUTES {
                let line = format!("GET {}", route.replace("{name}", "engine1").replace("{verb}", "reset"));
                heard(&line, headers, "").await;
            }
        }
        heard("POST /api/v1/logout", &format!("{JSON}{cookie}{ours}"), "{}").await;
    }

    /// What every other command says.
    fn commands(&self, file: &str, variables: &[(OsString, OsString)], said: &mut Said) {
        let mut all =
            vec![vec!["check", file], vec!["buffer", "plan", "-c", file], vec!["health", "-c", file]];
        let formats = ["table", "csv", "json", "md", "st"];
        all.extend(formats.map(|format| vec!["map", "-c", file, "--format", format]));
        all.push(vec!["map", "--frames", "-c", file]);
        for arguments in all {
            let mut command = self.program();
            let output = command.args(&arguments).envs(variables.iter().cloned()).output().unwrap();
            said.add_output(&arguments.join(" "), &output);
        }
    }

    /// What it wrote: log, standard output, and whatever else there is.
    fn files(&self, said: &mut Said) {
        let mut folders = vec![self.work.clone()];
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                } else {
                    said.add(path.display().to_string(), fs::read(&path).unwrap());
                }
            }
        }
    }

    fn log(&self) -> String {
        String::from_utf8_lossy(&fs::read(self.work.join("log")).unwrap()).into_owned()
    }
}

/// mosquitto, to which the gateway needs its password, and a listener without one for whoever watches.
fn mosquitto(folder: &Path) -> Option<(Running, SocketAddr, SocketAddr)> {
    let file = folder.join("passwords");
    let made =
        Command::new("mosquitto_passwd").args(["-b", "-c"]).arg(&file).args(["gateway", MQTT]).output();
    if made.is_err() {
        assert!(std::env::var_os("CI").is_none(), "mosquitto is not installed, and CI has to run this test");
        eprintln!("skipped: mosquitto is not installed (apt-get install mosquitto)");
        return None;
    }
    let [closed, open] = [free_address(), free_address()];
    let text = format!(
        "per_listener_settings true\nuser root\npersistence false\nlog_type none\n\
         listener {} 127.0.0.1\nallow_anonymous false\npassword_file {}\nlistener {} 127.0.0.1\nallow_anonymous true\n",
        closed.port(),
        file.display(),
        open.port()
    );
    fs::write(folder.join("mosquitto.conf"), text).unwrap();
    let mut command = Command::new("mosquitto");
    let broker =
        command.arg("-c").arg(folder.join("mosquitto.conf")).stdout(Stdio::null()).stderr(Stdio::null());
    Some((Running(broker.spawn().unwrap()), closed, open))
}

#[tokio::test]
async fn cr_1_5_secrets_that_work_are_told_to_nobody_at_the_most_talkative_level() {
    let folder = tempfile::tempdir().unwrap();
    let Some((_broker, address, open)) = mosquitto(folder.path()) else { return };
    until("mosquitto listens", async || TcpStream::connect(open).await.ok()).await;
    let probe = Probe::start(open, "probe").await;
    let plant = Plant::new(address);
    let file = plant.config(&plant.text);
    let mut said = Said::default();
    let gateway = plant.run(&file, &[]);
    probe.wait_for("the gateway is online", 0, |seen| seen.topic.ends_with("/bridge/state")).await;
    plant.exercise(&mut said).await;
    let verb = format!("cangate/{SHOWN}/bridge/request/acknowledge_all");
    probe.publish(&verb, b"{\"transaction\":\"a\"}", false).await;
    probe.wait_for("an answer", 0, |seen| seen.topic.contains("bridge/response")).await;
    plant.commands(&file, &[], &mut said);
    gateway.stop();
    for seen in probe.seen() {
        said.add(format!("topic {}", seen.topic), seen.payload);
    }
    plant.files(&mut said);
    let mut command = plant.program();
    let mut child = command
        .arg("password")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    std::io::Write::write_all(&mut child.stdin.take().unwrap(), format!("{PASSWORD}\n").as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    let made = String::from_utf8(output.stdout.clone()).unwrap();
    assert!(PasswordHash::parse(&made).unwrap().is_of(PASSWORD));
    assert_ne!(made.trim(), plant.hash.as_str());
    said.add_output("password", &output);
    let source = SourceText::new("cangate.toml", &plant.text);
    let loaded = config::load(&source, [], &mut |_| Err(std::io::ErrorKind::NotFound.into())).unwrap();
    said.add("Debug", format!("{loaded:?}"));

    // It was as talkative as it can be, and everybody got in who should.
    let log = plant.log();
    for shown in ["TRACE", SHOWN, "logged in"] {
        assert!(log.contains(shown), "{shown} is not in the log");
    }
    assert!(said.0.len() > 40, "{:?}", said.0.keys());
    assert!(!said.found(&[SHOWN.to_owned()]).is_empty());
    said.assert_silent(&plant.marks);
}

/// A way to get a secret wrong: the configuration and what else to change; whether the gateway starts all the same.
type Wrong = (&'static str, fn(&Plant) -> (String, Vec<(OsString, OsString)>));

fn line(plant: &Plant, from: &str, to: &str) -> (String, Vec<(OsString, OsString)>) {
    assert_eq!(plant.text.matches(from).count(), 1, "{from}");
    (plant.text.replace(from, to), Vec::new())
}

fn variable(plant: &Plant, name: &str, value: &[u8]) -> (String, Vec<(OsString, OsString)>) {
    (plant.text.clone(), vec![(name.into(), OsString::from_vec(value.to_vec()))])
}

/// The text as it is, with another secret in a file.
fn file(plant: &Plant, name: &str, content: &[u8]) -> (String, Vec<(OsString, OsString)>) {
    fs::write(plant.folder.path(name), content).unwrap();
    (plant.text.clone(), Vec::new())
}

const WRONG: [Wrong; 25] = [
    ("key: garbled", |plant| {
        file(plant, "gateway.key", b"-----BEGIN PRIVATE KEY-----\ncAnArY\n-----END PRIVATE KEY-----\n")
    }),
    ("key: base64 of nothing", |plant| {
        file(
            plant,
            "gateway.key",
            b"-----BEGIN PRIVATE KEY-----\nY0FuQXJZY0FuQXJZ\n-----END PRIVATE KEY-----\n",
        )
    }),
    ("key: no PEM", |plant| file(plant, "gateway.key", b"cAnArY")),
    ("key: encrypted", |plant| {
        file(
            plant,
            "gateway.key",
            b"-----BEGIN ENCRYPTED PRIVATE KEY-----\ncAnArY\n-----END ENCRYPTED PRIVATE KEY-----\n",
        )
    }),
    ("key in place of the certificate", |plant| {
        let key = fs::read(plant.folder.path("gateway.key")).unwrap();
        file(plant, "gateway.pem", &key)
    }),
    ("mqtt: no text", |plant| file(plant, "mqtt", b"cAnArY\xFF\n")),
    ("mqtt: wrong", |plant| file(plant, "mqtt", b"cAnArY-wrong\n")),
    ("mqtt: nobody may read it", |plant| {
        let path = plant.folder.path("mqtt");
        fs::set_permissions(path, std::os::unix::fs::PermissionsExt::from_mode(0o000)).unwrap();
        (plant.text.clone(), Vec::new())
    }),
    ("token: no text", |plant| file(plant, "token", b"cAnArY-0123456789\xFF")),
    ("token: too long", |plant| file(plant, "token", &b"cAnArY".repeat(1000))),
    ("token: too short", |plant| file(plant, "token", b"cAnArY")),
    ("password file: the password itself", |plant| file(plant, "maria", PASSWORD.as_bytes())),
    ("password file: another hash", |plant| {
        file(
            plant,
            "maria",
            b"$argon2id$v=19$m=999999999,t=2,p=1$cAnArYcAnArY$cAnArYcAnArYcAnArYcAnArYcAnArY",
        )
    }),
    ("password: itself", |plant| line(plant, &format!("\"{}\"", plant.hash.as_str()), "\"cAnArY-plain\"")),
    ("password: unquoted", |plant| line(plant, &format!("\"{}\"", plant.hash.as_str()), "cAnArY-plain")),
    ("password: not closed", |plant| line(plant, &format!("\"{}\"", plant.hash.as_str()), "\"cAnArY-plain")),
    ("password: a list", |plant| line(plant, &format!("\"{}\"", plant.hash.as_str()), "[\"cAnArY-plain\"]")),
    ("password: a table", |plant| {
        line(plant, &format!("\"{}\"", plant.hash.as_str()), "{ cAnArY = \"cAnArY\" }")
    }),
    ("password where a token file is meant", |plant| {
        line(plant, "token_file = ", "token = \"cAnArY-0123456789\" #")
    }),
    ("mqtt: password in the table", |plant| line(plant, "username = ", "password = \"cAnArY\"\nusername = ")),
    ("url with a password", |plant| line(plant, "url = \"mqtt://", "url = \"mqtt://gateway:cAnArY@")),
    ("variable: url with a password", |plant| {
        variable(plant, "CANGATE__MQTT__URL", b"mqtts://gateway:cAnArY@localhost")
    }),
    ("variable: password", |plant| variable(plant, "CANGATE__MQTT__PASSWORD", b"cAnArY")),
    ("variable: password that is no text", |plant| variable(plant, "CANGATE__MQTT__PASSWORD", b"cAnArY\xFF")),
    ("variable: password of an access", |plant| variable(plant, "CANGATE__ACCESS__JO__PASSWORD", b"cAnArY")),
];

#[tokio::test]
async fn cr_1_7_secrets_that_are_wrong_are_told_to_nobody_either() {
    let mut starts = 0;
    for (name, spoil) in WRONG {
        // Nobody listens there: the session is tried again and again.
        let plant = Plant::new("127.0.0.1:1".parse().unwrap());
        let (text, variables) = spoil(&plant);
        let path = plant.config(&text);
        let mut said = Said::default();
        let mut gateway = plant.run(&path, &variables);
        let is_up = until("it runs or ends", async || {
            let ended = gateway.0.try_wait().unwrap().is_some();
            let answers = plant.ask("GET /readyz", "", "").await.is_some_and(|answer| answer.code == 200);
            (ended || answers).then_some(answers)
        })
        .await;
        if is_up {
            starts += 1;
            tokio::time::timeout(PATIENCE, plant.exercise(&mut said)).await.unwrap();
        }
        plant.commands(&path, &variables, &mut said);
        gateway.stop();
        plant.files(&mut said);
        let found = said.found(&plant.marks);
        assert!(found.is_empty(), "{name}: {}", found.join("\n"));
        assert!(!is_up || plant.log().contains(SHOWN), "{name}");
    }
    assert!((5..20).contains(&starts), "some start and some do not: {starts}");
}
