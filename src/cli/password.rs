//! `cangate password`: makes the hash of a password that is typed or piped in. \[IO\]

use std::io::{self, IsTerminal, Read, Write};
use std::os::fd::AsFd;

use nix::sys::termios::{self, LocalFlags, SetArg, Termios};

use super::Exit;
use super::output::{print_error, print_line};
use crate::access::PasswordHash;
use crate::tls::random;

/// More is not read.
const LONGEST_LINE: u64 = 4_096;

/// Prints the hash on standard output. The password is never an argument: those stand in the list of processes.
pub(super) fn run() -> Exit {
    let password = if io::stdin().is_terminal() { typed() } else { piped(io::stdin()) };
    let password = match password {
        Ok(password) => password,
        Err(error) => {
            print_error(&format!("the password cannot be read: {error}"));
            return Exit::Io;
        }
    };
    let Some(password) = password else {
        print_error("the two are not the same; nothing was made");
        return Exit::Usage;
    };
    let salt = match random::bytes() {
        Ok(salt) => salt,
        Err(error) => {
            print_error(&error.to_string());
            return Exit::Io;
        }
    };
    match PasswordHash::of(&password, salt) {
        Ok(hash) => {
            print_line(hash.as_str());
            Exit::Ok
        }
        Err(error) => {
            print_error(&error.to_string());
            Exit::Usage
        }
    }
}

/// The first line of what is piped in.
fn piped(input: impl Read) -> io::Result<Option<String>> {
    let mut bytes = Vec::new();
    input.take(LONGEST_LINE).read_to_end(&mut bytes)?;
    let text = String::from_utf8(bytes).map_err(|_| io::Error::other("it is not UTF-8"))?;
    Ok(Some(text.lines().next().unwrap_or_default().to_owned()))
}

/// Typed twice, unseen; `None` where the two differ.
fn typed() -> io::Result<Option<String>> {
    let once = asked("Password: ")?;
    let again = asked("Once more: ")?;
    Ok((once == again).then_some(once))
}

fn asked(prompt: &str) -> io::Result<String> {
    let _ = write!(io::stderr().lock(), "{prompt}");
    let _ = io::stderr().flush();
    let unseen = Unseen::begin()?;
    let mut line = String::new();
    io::stdin().read_line(&mut line)?;
    drop(unseen);
    let _ = writeln!(io::stderr().lock());
    Ok(line.trim_end_matches(['\n', '\r']).to_owned())
}

/// While it lives, the terminal does not show what is typed.
struct Unseen(Termios);

impl Unseen {
    fn begin() -> io::Result<Self> {
        let before = termios::tcgetattr(io::stdin().as_fd())?;
        let mut unseen = before.clone();
        unseen.local_flags.remove(LocalFlags::ECHO);
        termios::tcsetattr(io::stdin().as_fd(), SetArg::TCSAFLUSH, &unseen)?;
        Ok(Self(before))
    }
}

impl Drop for Unseen {
    fn drop(&mut self) {
        // Where the terminal is gone there is nothing to show it on.
        let _ = termios::tcsetattr(io::stdin().as_fd(), SetArg::TCSAFLUSH, &self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_line_of_what_is_piped_in_counts_and_white_space_in_it_too() {
        let read = |bytes: &'static [u8]| piped(bytes).ok().flatten();
        assert_eq!(read(b" a b \nc").as_deref(), Some(" a b "));
        assert_eq!(read(b"secret\r\n").as_deref(), Some("secret"));
        assert_eq!(read(b"").as_deref(), Some(""));
        assert_eq!(read(b"\xFF"), None);
    }
}
